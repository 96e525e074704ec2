"""Every command of the page about clusters, and every failure that the page describes."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from common import ROOT

PAGE = (ROOT / "book" / "cluster.md").read_text(encoding="utf-8")
LOCAL, SCHEDULER, WORKERS, DASK, MPI, PARTS = re.findall(
    r"^```sh\n(.*?)\n```$", PAGE, re.M | re.S
)
# Trial 20 can kill its worker, and trials can be held until a test has looked.
BESIDE = """
import os, signal, time
from pathlib import Path

def begin(which):
    with Path(LOG, str(which)).open("a") as log:
        log.write("x")
    if which == 20 and Path(LOG, "fatal").exists():
        Path(LOG, "fatal").unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    while any(which >= int(hold.suffix[1:]) for hold in Path(LOG).glob("hold.*")):
        time.sleep(0.01)
"""
BIN = os.path.dirname(sys.executable)
ENVIRONMENT = {
    **os.environ,
    "PATH": os.pathsep.join([BIN, os.environ["PATH"]]),
    "PYTHONPATH": os.pathsep.join(p for p in sys.path if p),
}
Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the page's script in two parts; each trial reports its start to a local module."""
    folder = tmp_path_factory.mktemp("page")
    text = (ROOT / "book" / "examples" / "cluster.py").read_text(encoding="utf-8")
    # One step of the filter in place of ten, and a report of each trial's start
    for old, new in [
        ("import sys\n", "import beside\nimport sys\n"),
        ("[5:,", "[:,"),
        ("    rng = ", "    beside.begin(seed.spawn_key[0])\n    rng = "),
        ("np.arange(1, 11) * 0.5", "[0.5]"),
    ]:
        assert text.count(old) == 1
        text = text.replace(old, new)
    (folder / "cluster.py").write_text(text, encoding="utf-8")
    count_starts(folder)
    # One worker: nothing of this reference depends on the order of trials.
    one = ENVIRONMENT | {"LOKY_MAX_CPU_COUNT": "1"}
    subprocess.run(["sh", "-ec", PARTS], cwd=folder, env=one, check=True)
    return folder


def count_starts(folder: Path) -> None:
    """Write a module beside the script that counts the starts of each trial."""
    (folder / "beside.py").write_text(BESIDE.replace("LOG", repr(str(folder / "log"))))
    for name in ("log", "elsewhere"):
        (folder / name).mkdir()


@pytest.fixture
def folder(script: Path, tmp_path: Path) -> Path:
    """Copy the script, which has not run yet."""
    shutil.copy(script / "cluster.py", tmp_path)
    count_starts(tmp_path)
    return tmp_path


@pytest.fixture
def start(folder: Path) -> Iterator[Start]:
    """Start a command of the page beside the script, or in another folder."""
    processes = []

    def start_command(command: str, cwd: Path = folder) -> subprocess.Popen[str]:
        # `exec` replaces the shell, so that a signal reaches the command itself.
        lines = command if "\n" in command else f"exec {command}"
        processes.append(
            subprocess.Popen(
                ["sh", "-ec", lines],
                cwd=cwd,
                env=ENVIRONMENT,
                text=True,
                start_new_session=True,
                stdout=(cwd / "output").open("w"),
                stderr=subprocess.STDOUT,
            )
        )
        return processes[-1]

    yield start_command
    for process in processes:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def start_counts(folder: Path) -> list[int]:
    return [len(path.read_text()) for path in (folder / "log").glob("[0-9]*")]


def kill_after(n: int, folder: Path, start: Start, command: str, *victims: Any) -> str:
    """Kill processes, by default the client, after n trials; return the client's output."""
    # Trials from number n on wait, so that the client is killed while they run.
    hold = folder / "log" / f"hold.{n}"
    hold.touch()
    client = start(command)
    while len(start_counts(folder)) <= n and client.poll() is None:
        time.sleep(0.01)
    for victim in victims or [client]:
        os.killpg(victim.pid, signal.SIGKILL)
    # A killed client leaves a part, and no file that looks complete.
    assert client.wait(300) != 0
    assert not (folder / "errors.csv").exists()
    hold.unlink()
    return (folder / "output").read_text()


def same(folder: Path, script: Path, twice: int) -> None:
    """Check that the file is the same, and that at most so many trials ran twice."""
    assert (folder / "errors.csv").read_bytes() == (script / "errors.csv").read_bytes()
    assert not (folder / "errors.csv.part").exists()
    # Every trial ran; only those in flight at a kill may have run again.
    assert len(start_counts(folder)) == 40
    assert sum(start_counts(folder)) <= 40 + twice


def test_on_this_machine_or_in_parts_that_are_merged(
    folder: Path, script: Path, start: Start
) -> None:
    kill_after(20, folder, start, LOCAL)
    time.sleep(1.0)  # workers notice that their parent is gone, and end
    assert start(LOCAL).wait() == 0
    same(folder, script, twice=os.cpu_count() or 1)
    same(script, script, twice=0)


@pytest.mark.slow
def test_dask(folder: Path, script: Path, start: Start) -> None:
    pytest.importorskip("distributed", reason="distributed (Dask) is not installed")

    def cluster() -> list[subprocess.Popen[str]]:
        """Start a scheduler, and workers that cannot read the folder of the script."""
        (folder / "cluster.json").unlink(missing_ok=True)
        scheduler = start(SCHEDULER, folder)
        while not (folder / "cluster.json").exists():
            assert scheduler.poll() is None
            time.sleep(0.05)
        shutil.copy(folder / "cluster.json", folder / "elsewhere")
        return [scheduler, start(WORKERS, folder / "elsewhere")]

    machines = cluster()
    kill_after(20, folder, start, DASK)
    # The worker of trial 20 dies, and Dask recovers without the client.
    (folder / "log" / "fatal").touch()
    output = kill_after(28, folder, start, DASK, machines[0])
    assert re.search(r"StudyError: .*finished trials are in errors\.csv\.part", output)
    assert not (folder / "log" / "fatal").exists()
    cluster()
    assert start(DASK).wait() == 0
    same(folder, script, twice=2 + 1 + 2)


@pytest.mark.slow
def test_mpi(folder: Path, script: Path, start: Start) -> None:
    pytest.importorskip("mpi4py", reason="mpi4py is not installed")
    if subprocess.run("mpiexec -n 1 true", shell=True, env=ENVIRONMENT).returncode:
        pytest.skip("mpiexec does not run here")
    (folder / "log" / "fatal").touch()
    assert start(MPI).wait() != 0
    assert not (folder / "errors.csv").exists()
    assert start(MPI).wait() == 0
    same(folder, script, twice=2)
