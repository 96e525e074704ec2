"""The checks of the book must be able to fail: a small chapter is broken in every way.

The commands are those of ``make test``, on copies of the chapter in ``fixtures``: the comparison
of the pair, and nbval on the stored outputs. All faults of single cells are in one notebook, so
that nbval runs once.
"""

from __future__ import annotations

import base64
import io
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import psutil
import pytest
from PIL import Image

import execute
import pairs
from common import ROOT
from pictures import difference, extract_pictures, shrink_picture

TOOLS = ROOT / "book" / "tools"
SMALL = Path(__file__).parent / "fixtures" / "small.md"


def tool(name: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run one of the book's tools as the Makefile does."""
    # A process of its own, so that exit codes and stderr are those of `make`.
    command = [sys.executable, str(TOOLS / name), *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def scratch() -> Iterator[Path]:
    """Yield a scratch folder inside the repository, where its conftest.py is found."""
    (ROOT / "_build").mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="guard-", dir=ROOT / "_build") as path:
        yield Path(path)


folder = pytest.fixture(scratch)
executed_folder = pytest.fixture(scratch, scope="module")


@pytest.fixture(scope="module")
def execution(executed_folder: Path) -> subprocess.CompletedProcess[str]:
    """Execute the small chapter, and two that must be rejected, in one call."""
    text = SMALL.read_text(encoding="utf-8")
    sources = [
        executed_folder / f"{name}.md" for name in ("small", "rejected", "failed")
    ]
    for path, lines in zip(
        sources, ([], REJECTED, ["raise ValueError('no')"]), strict=True
    ):
        code = "".join(f"```{{code-cell}} ipython3\n{line}\n```\n\n" for line in lines)
        path.write_text(
            text.split("```")[0] + code if lines else text, encoding="utf-8"
        )
        # A rejected chapter must leave this file alone.
        path.with_suffix(".ipynb").write_text("as it was")
    return tool("execute.py", *sources)


@pytest.mark.parametrize("name", ["execute.py", "regress.py"])
def test_a_time_limit_leaves_no_process(
    name: str, executed: Path, folder: Path
) -> None:
    # A cell that would run for ten minutes, and a mark that it runs
    started = folder / "started"
    cell = (
        f"import pathlib, time\npathlib.Path({str(started)!r}).touch()\ntime.sleep(600)"
    )
    header = (executed / "small.md").read_text(encoding="utf-8").split("```")[0]
    page = folder / "endless.md"
    page.write_text(f"{header}```{{code-cell}} ipython3\n{cell}\n```\n")
    notebook = execute.read(page)
    nbformat.write(notebook, page.with_suffix(".ipynb"))
    process = subprocess.Popen(
        [sys.executable, TOOLS / name, page], cwd=ROOT, stdout=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 120
    while not started.exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    children = psutil.Process(process.pid).children(recursive=True)
    assert children
    process.terminate()
    assert process.wait(timeout=60) == 128 + signal.SIGTERM
    _, alive = psutil.wait_procs(children, timeout=30)
    assert not alive


@pytest.fixture(scope="module")
def executed(execution: object, executed_folder: Path) -> Path:
    """Return a folder with the small chapter, executed once."""
    return executed_folder


@pytest.fixture
def chapter(executed: Path, folder: Path) -> Path:
    """Return a fresh copy of the executed small chapter."""
    # Executing is slow; each test changes a copy of one execution.
    for name in ("small.md", "small.ipynb"):
        shutil.copy(executed / name, folder)
    return folder / "small.md"


def read_notebook(source: Path) -> Any:
    return nbformat.read(source.with_suffix(".ipynb"), as_version=4)


def store(source: Path, notebook: Any) -> Path:
    """Write a notebook, beside it a source of its name."""
    source.touch()
    nbformat.write(notebook, source.with_suffix(".ipynb"))
    return source


def code_cells(notebook: Any) -> list[Any]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def bundle(cell: Any) -> Any:
    """Return the data of the cell's only output that is more than text."""
    (data,) = [o.data for o in cell.outputs if "data" in o]
    return data


def shade_pixels(png: str, share: float, by: int) -> str:
    """Return the picture with a changed shade in a fraction of its pixels."""
    image = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")
    pixels = np.asarray(image).astype(int)
    chosen = np.random.default_rng(1).random(pixels.shape[:2]) < share
    # Bright pixels become darker and dark ones brighter, so that no shade leaves
    # 0..255.
    pixels[chosen] += np.where(pixels[chosen] > 127, -by, by)
    return as_png(pixels)


def as_png(pixels: np.ndarray) -> str:
    file = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(file, format="png")
    return base64.b64encode(file.getvalue()).decode()


def shade(cell: Any) -> None:
    bundle(cell)["image/png"] = shade_pixels(bundle(cell)["image/png"], 0.5, 20)


def exchange_frames(cell: Any) -> None:
    data = bundle(cell)
    html, frames = extract_pictures(data["text/html"])
    # The first one shown, then all three
    assert len(frames) == 4
    assert frames[0] == frames[2]
    # Equal frames could be exchanged without any difference.
    assert len(set(frames)) == 3
    # Exchange two frames by way of a mark; the text around the frames stays.
    swapped = (
        data["text/html"].replace(frames[1], "first").replace(frames[3], frames[1])
    )
    data["text/html"] = swapped.replace("first", frames[3])
    assert extract_pictures(data["text/html"])[0] == html


def source(old: str, new: str) -> Callable[[Any], None]:
    def change(cell: Any) -> None:
        assert cell.source.count(old) == 1
        cell.source = cell.source.replace(old, new)

    return change


def exchange_picture(cell: Any) -> None:
    bundle(cell)["image/png"] = shade_pixels(bundle(cell)["image/png"], 0.1, 120)


# The small chapter's cells, in order
PRINT, FIGURE, SLIDER, VERDICT = range(4)
FAULTS: dict[str, tuple[int, Callable[[Any], object], str]] = {
    "digit": (PRINT, lambda c: c.outputs[0].update(text="rate 2.0001\n"), "2.0001"),
    "verdict": (
        VERDICT,
        lambda c: next(v for k, v in bundle(c).items() if k.endswith("json")).update(
            ours="0.1354"
        ),
        "0.1354",
    ),
    "broken cell": (PRINT, source("{rate:.4f}", "{rote:.4f}"), "rote"),
    "curve": (FIGURE, source("ax.plot(t, curve)", "ax.plot(t, 1.01 * curve)"), "mean"),
    "curve that moves": (
        SLIDER,
        source("np.exp(-rate * t)", "1.01 * np.exp(-rate * t)"),
        "data-frames",
    ),
    "no picture": (FIGURE, lambda c: bundle(c).pop("image/png"), "0 pictures stored"),
    "no picture beside the frames": (
        SLIDER,
        lambda c: bundle(c).pop("image/png"),
        "drawn",
    ),
    "another picture": (FIGURE, exchange_picture, "pixels"),
    "exchanged frames": (SLIDER, exchange_frames, "pixels"),
    "another processor's shades": (FIGURE, shade, ""),
    "its shades beside the frames": (SLIDER, shade, ""),
}
"""The cell, its change, and the expected message; '' for an accepted change."""


def test_one_changed_output_or_source_fails_and_no_other(
    executed: Path, folder: Path
) -> None:
    # The unchanged cells come first, then one changed cell for each fault.
    cells = code_cells(read_notebook(executed / "small.md"))
    untouched = len(cells)
    # Without a fault no check complains: later complaints are due to the changes alone.
    assert pairs.check(executed / "small.md") == []
    for which, change, _ in FAULTS.values():
        cells.append(nbformat.from_dict(cells[which]))
        change(cells[-1])
    for k, cell in enumerate(cells):
        cell["id"] = f"cell-{k}"
    notebook = nbformat.v4.new_notebook(
        cells=cells, metadata={"kernelspec": execute.KERNELSPEC}
    )
    result = tool("regress.py", store(folder / "broken.md", notebook))
    assert result.returncode == 1
    assert "broken: differs" in result.stdout
    # pytest prints one block for each cell that differs; text and number alternate.
    parts = re.split(r"^_+ .*Cell (\d+) _+$", result.stderr, flags=re.M)
    messages = dict(zip(map(int, parts[1::2]), parts[2::2], strict=True))
    expected = {
        k: text for k, (*_, text) in enumerate(FAULTS.values(), untouched) if text
    }
    # Exactly the faulty cells differ, each with the message of its fault.
    assert set(messages) == set(expected)
    assert [k for k, text in expected.items() if text not in messages[k]] == []


def test_pixels_may_differ_if_few_or_little(executed: Path) -> None:
    png = bundle(code_cells(read_notebook(executed / "small.md"))[FIGURE])["image/png"]
    # 0.2 % of the pixels by a large shade is too much, 0.01 % is accepted.
    assert difference(shade_pixels(png, 0.002, 120), png).startswith("differs in 0.2")
    assert difference(shade_pixels(png, 0.0001, 120), png) == ""
    assert difference(png, "a") == "is no picture"


def test_a_lighter_picture_shows_the_same() -> None:
    # Noise of 64 colours fits a palette, noise of all colours does not.
    noise = np.random.default_rng(1).integers(0, 256, (200, 200, 3))
    # 4 shades of 3 colours make 64.
    few_colours = as_png(noise // 64 * 80)
    many_colours = as_png(noise)
    assert len(shrink_picture(few_colours)) < 0.9 * len(few_colours)
    assert difference(shrink_picture(few_colours), few_colours) == ""
    # Shrinking twice is shrinking once, so that stored bytes do not change.
    assert shrink_picture(many_colours) == many_colours
    assert shrink_picture(shrink_picture(few_colours)) == shrink_picture(few_colours)


def clear(cell: Any) -> None:
    cell.outputs = []
    cell.execution_count = None


def copies(cell: Any, number: int) -> None:
    cell.outputs = cell.outputs * number


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda c: clear(c[PRINT]), "execution count None"),
        (lambda c: copies(c[FIGURE], 2), "with 2 pictures, needs one"),
        (lambda c: bundle(c[FIGURE]).pop("image/png"), "with 0 pictures, needs one"),
        (
            lambda c: bundle(c[FIGURE]).update({"text/plain": "<Figure size 440x275>"}),
            "without the digest of its axes",
        ),
        (
            lambda c: c[PRINT].outputs[0].update(text="x" * 80),
            "80 characters printed, at most 79",
        ),
    ],
)
def test_a_stored_output_is_rejected(
    chapter: Path, change: Callable[[Any], object], complaint: str
) -> None:
    notebook = read_notebook(chapter)
    change(code_cells(notebook))
    store(chapter, notebook)
    # Also complaints of the other checks may be there.
    assert complaint in "\n".join(pairs.check(chapter))


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        (
            "alt: One curve that falls from 1 at time 0 to 0.14 at time 1.",
            "width: 80%",
            "alt",
        ),
        ("    caption: The curve {eq}`eq-small`.\n", "", "caption"),
        ("rate = 2.0", "rate = 2.0  # " + "x" * 70, "at most 79"),
    ],
    ids=["no alternative text", "no caption", "long line"],
)
def test_new_sources_keep_the_outputs_and_are_checked(
    chapter: Path, old: str, new: str, complaint: str
) -> None:
    before = read_notebook(chapter)
    text = chapter.read_text(encoding="utf-8")
    # A change of the Markdown alone is a difference from the notebook.
    assert text.count(old) == 1
    chapter.write_text(text.replace(old, new), encoding="utf-8")
    assert "differs between the Markdown and the notebook" in "\n".join(
        pairs.check(chapter)
    )
    # Copying the cells repairs the pair, and keeps the outputs.
    assert execute.copy_sources(chapter) == ""
    after = read_notebook(chapter)
    assert [c.get("outputs") for c in before.cells] == [
        c.get("outputs") for c in after.cells
    ]
    # The new source has a fault of its own, which is still seen.
    (problem,) = pairs.check(chapter)
    assert complaint in problem
    # With one more cell, outputs would belong to other cells.
    chapter.write_text(
        text + "\n```{code-cell} ipython3\n1 + 1\n```\n", encoding="utf-8"
    )
    assert "other cells" in execute.copy_sources(chapter)


REJECTED = {
    "import warnings; warnings.warn('careful')": "wrote to stderr",
    "import sys; print(sys.prefix)": "its output holds",
    "object()": "its output holds",
}


def test_execution_rejects(execution: Any, executed: Path) -> None:
    assert execution.returncode == 1
    assert "failed: a cell failed" in execution.stderr
    # One block for each output that cannot be stored
    cells = re.split(r"^cell [\w-]+:\n", execution.stderr, flags=re.M)[1:]
    for cell, (line, complaint) in zip(cells, REJECTED.items(), strict=True):
        assert cell.startswith(line)
        assert complaint in cell
    # Both chapters were executed, and neither was stored.
    unchanged = {
        path.stem
        for path in executed.glob("*.ipynb")
        if path.read_text() == "as it was"
    }
    assert unchanged == {"rejected", "failed"}
    assert re.findall(r"^\w+", execution.stdout, re.M) == ["small"]


def test_executing_again_gives_the_same_bytes(
    executed: Path, chapter: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = chapter.with_suffix(".ipynb")
    text = path.read_text(encoding="utf-8")
    # The strictest comparison, of a second execution with the stored bytes
    result = tool("execute.py", "--bytes", executed / "small.md")
    assert result.returncode == 0
    assert result.stderr == ""
    assert "widget-state+json" in text
    assert "version" not in read_notebook(chapter)["metadata"]["language_info"]
    assert str(ROOT) not in text
    # A stored digit that is wrong must be found. No second kernel is needed for that.
    path.write_text(text.replace("rate 2.0000", "rate 2.0001"), encoding="utf-8")
    monkeypatch.setattr(
        execute, "run", lambda new, _: new.update(read_notebook(executed / "small.md"))
    )
    monkeypatch.setattr(execute.os, "environ", dict(execute.os.environ))
    assert "does not give the stored bytes" in execute.execute(chapter, True, True)
    notebook = nbformat.reads(text, as_version=4)
    # Texts are equal; only the pixels tell.
    exchange_picture(code_cells(notebook)[FIGURE])
    assert "pixels" in execute.unlike(text, execute.dump(notebook), False)
