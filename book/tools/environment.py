"""Make the environment in which everything runs, whole or not at all.

    python book/tools/environment.py FOLDER

The folder of the environment is made afresh unless it was made whole, here: its stamp, written
last, names the folder of the repository, since an editable install points there. So an interrupted
make, a moved repository and a copied one all recover. Needs nothing but Python.
"""

import os
import shutil
import subprocess
import sys

OLDEST = (3, 11)


def run(python, *arguments):
    """Run a command of the environment's Python; leave if it fails."""
    code = subprocess.call([python, *arguments])
    if code:
        sys.exit(code)


def is_complete(folder, here):
    """Say whether the environment is whole, works, and was made in this repository."""
    python = os.path.join(folder, "bin", "python")
    try:
        with open(os.path.join(folder, "stamp"), encoding="utf-8") as stamp:
            if stamp.read() != here + "\n":
                return False
        return subprocess.call([python, "-c", ""], stderr=subprocess.DEVNULL) == 0
    except OSError:
        return False


def main():
    folder = sys.argv[1]
    here = os.getcwd()
    if sys.version_info < OLDEST:
        found = ".".join(map(str, sys.version_info[:3])) + " (" + sys.executable + ")"
        sys.exit(
            "Python 3.11 or newer is needed, got "
            + found
            + ": make PYTHON=/path/to/python"
        )
    stamp = os.path.join(folder, "stamp")
    python = os.path.join(folder, "bin", "python")
    if is_complete(folder, here):
        os.remove(stamp)  # until the update is whole too
    else:
        shutil.rmtree(folder, ignore_errors=True)
        run(sys.executable, "-m", "venv", folder)
    pip = ("-m", "pip", "install", "--quiet", "--disable-pip-version-check")
    # The list is whole. Older versions of pip, asked to resolve `name[extra]`, take the newest
    # release instead of the listed one, and refuse it for want of a hash.
    run(python, *pip, "--no-deps", "--require-hashes", "-r", "requirements.txt")
    for package in (".", "book/kit"):
        run(python, *pip, "--no-deps", "--no-build-isolation", "--editable", package)
    run(python, "-W", "ignore", "-c", "import matplotlib.font_manager")
    with open(stamp + ".new", "w", encoding="utf-8") as out:
        out.write(here + "\n")
    os.replace(stamp + ".new", stamp)


if __name__ == "__main__":
    main()
