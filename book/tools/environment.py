"""Make the environment of the book and the library, completely or not at all.

    python book/tools/environment.py FOLDER

The environment is made from scratch unless its stamp is there. The stamp is written last and names
the folder of the repository, to which the editable install points. So an interrupted make, a moved
repository and a copied one all recover. This script needs only Python.
"""

import os
import shutil
import subprocess
import sys

OLDEST = (3, 11)


def succeeds(python, *arguments):
    """Run a command of the environment's Python; return whether it succeeds."""
    return subprocess.call([python, *arguments]) == 0


def run(python, *arguments):
    """Run a command of the environment's Python; exit if it fails."""
    if not succeeds(python, *arguments):
        sys.exit(1)


def is_complete(folder, repository):
    """Return whether the environment is complete, works, and belongs to this repository."""
    python = os.path.join(folder, "bin", "python")
    try:
        # The stamp names the repository for which the environment was made.
        with open(os.path.join(folder, "stamp"), encoding="utf-8") as stamp:
            if stamp.read() != repository + "\n":
                return False
        # A broken link to a removed Python fails here.
        return subprocess.call([python, "-c", ""], stderr=subprocess.DEVNULL) == 0
    except OSError:
        return False


def find_locked_lines(name):
    """Return the lines of requirements.txt that name one package and its hashes."""
    with open("requirements.txt", encoding="utf-8") as file:
        text = file.read()
    start = text.index("\n" + name + "==") + 1
    # The lines that belong to an entry are indented.
    end = start
    for line in text[start:].splitlines(True):
        if end > start and not line.startswith(" "):
            break
        end += len(line)
    return text[start:end]


def install_packages(python, folder):
    """Install the locked packages, then the library and the kit as links.

    uv takes a tenth of pip's time. It does not read pip's settings, so where pip is told of a
    mirror uv may reach nothing: then pip installs the same files.
    """
    pip = ("-m", "pip", "install", "--quiet", "--disable-pip-version-check")
    uv = ("-m", "uv", "pip", "install", "--quiet", "--system-certs", "--python", python)
    # The list is complete, so dependencies need no resolution. For `name[extra]` older versions of
    # pip would take the newest release instead of the listed one, and reject it without a hash.
    exact = ("--no-deps", "--require-hashes", "-r")
    first = os.path.join(folder, "uv.txt")
    with open(first, "w", encoding="utf-8") as file:
        file.write(find_locked_lines("uv"))
    run(python, *pip, *exact, first)
    installer = uv
    if not succeeds(python, *uv, *exact, "requirements.txt"):
        print("uv could not install the packages; pip does", flush=True)
        installer = pip
        run(python, *pip, *exact, "requirements.txt")
    # Links, so that edits count at once.
    linked = ("--no-deps", "--no-build-isolation", "--editable")
    for package in (".", "book/kit"):
        run(python, *installer, *linked, package)


def main():
    folder = sys.argv[1]
    repository = os.getcwd()
    if sys.version_info < OLDEST:
        # Joined by +, not an f-string: a very old Python has to parse this file too.
        version = ".".join(map(str, sys.version_info[:3])) + " (" + sys.executable + ")"
        sys.exit(
            "Python 3.11 or newer is needed, got "
            + version
            + ": make PYTHON=/path/to/python"
        )
    stamp = os.path.join(folder, "stamp")
    python = os.path.join(folder, "bin", "python")
    if is_complete(folder, repository):
        # Without a stamp, an interrupted update is made again.
        os.remove(stamp)
    else:
        shutil.rmtree(folder, ignore_errors=True)
        run(sys.executable, "-m", "venv", folder)
    install_packages(python, folder)
    # matplotlib's first import lists the fonts and may warn: here, not in a chapter.
    run(python, "-W", "ignore", "-c", "import matplotlib.font_manager")
    # Replacing a file is one step: the stamp is there completely or not at all.
    with open(stamp + ".new", "w", encoding="utf-8") as file:
        file.write(repository + "\n")
    os.replace(stamp + ".new", stamp)


if __name__ == "__main__":
    main()
