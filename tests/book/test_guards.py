"""What guards the book must itself be able to fail: a small chapter is broken in every way.

Each test runs the commands of ``make test`` on a copy of the chapter in ``fixtures``: the
comparison of the pair, and nbval over the stored outputs.
"""

from __future__ import annotations

import base64
import io
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jupytext
import nbformat
import numpy as np
import pytest
from PIL import Image

import pairs
from pictures import difference, taken_out

ROOT = Path(__file__).resolve().parents[2]
TOOLS = ROOT / "book" / "tools"
FIXTURES = Path(__file__).parent / "fixtures"


def tool(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run one of the book's tools as the Makefile does."""
    command = [sys.executable, str(TOOLS / name), *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def passes(source: Path) -> bool:
    """Say whether `make test` would accept the chapter; the pair first, as it is cheaper."""
    return not pairs.check(source) and tool("regress.py", str(source)).returncode == 0


def scratch() -> Iterator[Path]:
    """Yield a scratch folder inside the repository, where its conftest.py is found."""
    (ROOT / "_build").mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="guard-", dir=ROOT / "_build") as path:
        yield Path(path)


folder = pytest.fixture(scratch)
executed_folder = pytest.fixture(scratch, scope="module")


@pytest.fixture(scope="module")
def executed(executed_folder: Path) -> Path:
    """Return a folder with the small chapter, executed once."""
    shutil.copy(FIXTURES / "small.md", executed_folder)
    done = tool("execute.py", str(executed_folder / "small.md"))
    assert done.returncode == 0, done.stderr
    return executed_folder


@pytest.fixture
def chapter(executed: Path, folder: Path) -> Path:
    """Return a fresh copy of the executed small chapter."""
    for name in ("small.md", "small.ipynb"):
        shutil.copy(executed / name, folder)
    return folder / "small.md"


def stored(source: Path) -> Any:
    return nbformat.read(source.with_suffix(".ipynb"), as_version=4)


def store(source: Path, notebook: Any) -> None:
    nbformat.write(notebook, source.with_suffix(".ipynb"))


def code_cells(notebook: Any) -> list[Any]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def change_source(source: Path, old: str, new: str) -> None:
    """Replace text in both files of the pair, so that only the outputs disagree."""
    text = source.read_text(encoding="utf-8")
    assert text.count(old) == 1
    source.write_text(text.replace(old, new), encoding="utf-8")
    notebook = stored(source)
    for cell in notebook.cells:
        cell.source = cell.source.replace(old, new)
    store(source, notebook)


def test_untouched_chapter_passes(chapter: Path) -> None:
    assert passes(chapter)


@pytest.mark.parametrize(
    ("old", "new"),
    [("rate 2.0000", "rate 2.0001"), ('"ours": "0.1353"', '"ours": "0.1354"')],
    ids=["digit", "verdict"],
)
def test_a_changed_output_fails(chapter: Path, old: str, new: str) -> None:
    path = chapter.with_suffix(".ipynb")
    text = path.read_text(encoding="utf-8")
    assert text.count(old) == 1
    path.write_text(text.replace(old, new), encoding="utf-8")
    assert pairs.check(chapter) == []
    assert tool("regress.py", str(chapter)).returncode == 1


@pytest.mark.parametrize("counts", [True, False], ids=["counts kept", "counts cleared"])
def test_cleared_outputs_fail(chapter: Path, counts: bool) -> None:
    notebook = stored(chapter)
    for cell in code_cells(notebook):
        cell.outputs = []
        if not counts:
            cell.execution_count = None
    store(chapter, notebook)
    assert not passes(chapter)


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('print(f"rate {rate:.4f}")', 'print(f"rate {rote:.4f}")', "rote"),
        ("ax.plot(t, curve)", "ax.plot(t, 1.01 * curve)", "mean"),
        ("ax.plot(t, np.exp(-rate * t))", "ax.plot(t, 1.01 * np.exp(-rate * t))", "data-frames"),
    ],
    ids=["broken cell", "figure", "moving frames"],
)
def test_a_changed_cell_fails_and_a_changed_curve_through_its_digest(
    chapter: Path, old: str, new: str, complaint: str
) -> None:
    change_source(chapter, old, new)
    assert pairs.check(chapter) == []
    done = tool("regress.py", str(chapter))
    assert done.returncode == 1 and complaint in done.stderr


def pictures(notebook: Any) -> list[Any]:
    """The bundles of the chapter's figure and of its slider."""
    outputs = [output for cell in code_cells(notebook) for output in cell.outputs]
    found = [output.data for output in outputs if "image/png" in output.get("data", {})]
    assert len(found) == 2 and "text/html" in found[1]
    return found


@pytest.mark.parametrize("which", [0, 1], ids=["figure", "slider"])
def test_removed_picture_fails(chapter: Path, which: int) -> None:
    notebook = stored(chapter)
    del pictures(notebook)[which]["image/png"]
    store(chapter, notebook)
    assert pairs.check(chapter)
    assert tool("regress.py", str(chapter)).returncode == 1


def test_exchanged_picture_fails(chapter: Path) -> None:
    notebook = stored(chapter)
    figure, moving = pictures(notebook)
    figure["image/png"] = moving["image/png"]
    store(chapter, notebook)
    assert pairs.check(chapter) == []
    done = tool("regress.py", str(chapter))
    assert done.returncode == 1 and "pixels" in done.stderr
    assert tool("execute.py", "--check", str(chapter)).returncode == 1


def test_exchanged_frames_fail(chapter: Path) -> None:
    notebook = stored(chapter)
    moving = pictures(notebook)[1]
    html, frames = taken_out(moving["text/html"])
    assert len(frames) == 4 and frames[0] == frames[2]  # the first one shown, then all three
    assert len(set(frames)) == 3
    swapped = moving["text/html"].replace(frames[1], "first").replace(frames[3], frames[1])
    moving["text/html"] = swapped.replace("first", frames[3])
    store(chapter, notebook)
    assert taken_out(moving["text/html"])[0] == html
    done = tool("regress.py", str(chapter))
    assert done.returncode == 1 and "pixels" in done.stderr


def shaded(png: str, share: float, by: int) -> str:
    """The picture with some of its pixels shaded otherwise."""
    image = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")
    pixels = np.asarray(image).astype(int)
    chosen = np.random.default_rng(1).random(pixels.shape[:2]) < share
    pixels[chosen] += np.where(pixels[chosen] > 127, -by, by)
    out = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(out, format="png")
    return base64.b64encode(out.getvalue()).decode()


def test_another_machine_s_shades_pass(chapter: Path) -> None:
    notebook = stored(chapter)
    for bundle in pictures(notebook):
        bundle["image/png"] = shaded(bundle["image/png"], 0.5, 20)
    store(chapter, notebook)
    assert passes(chapter)
    png = pictures(stored(chapter))[0]["image/png"]
    assert difference(shaded(png, 0.002, 120), png).startswith("differs in 0.2")
    assert difference(shaded(png, 0.0001, 120), png) == ""
    assert difference(png, "a") == "is no picture"


def test_a_picture_without_its_digest_is_refused(chapter: Path) -> None:
    notebook = stored(chapter)
    assert not pictures(notebook)[0]["text/plain"].startswith("<")
    pictures(notebook)[0]["text/plain"] = "<Figure size 440x275 with 1 Axes>"
    store(chapter, notebook)
    assert "without the digest of its axes" in "\n".join(pairs.check(chapter))


def test_two_pictures_or_none_in_a_figure_s_cell_are_refused(chapter: Path) -> None:
    for copies in (0, 2):
        notebook = stored(chapter)
        (cell,) = [c for c in code_cells(notebook) if "fig-small" in str(c.metadata)]
        picture = [o for o in cell.outputs if "image/png" in o.get("data", {})]
        cell.outputs = [o for o in cell.outputs if o not in picture] + picture * copies
        path = chapter.with_name(f"copies{copies}.md")
        path.write_bytes(chapter.read_bytes())
        store(path, notebook)
        assert f"with {copies} pictures, needs one" in "\n".join(pairs.check(path))


def test_changed_prose_fails(chapter: Path) -> None:
    text = chapter.read_text(encoding="utf-8")
    chapter.write_text(text.replace("The curve is", "The line is"), encoding="utf-8")
    assert "source differs" in "\n".join(pairs.check(chapter))


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("alt: One curve that falls from 1 at time 0 to 0.14 at time 1.", "width: 80%", "alt"),
        ("    caption: The curve {eq}`eq-small`.\n", "", "caption"),
        ("rate = 2.0", "rate = 2.0  # " + "x" * 70, "at most 79"),
        ('print(f"rate {rate:.4f}")', 'print("x" * 80)', "80 characters printed, at most 79"),
    ],
    ids=["no alternative text", "no caption", "long line", "long output"],
)
def test_pair_check_refuses(chapter: Path, old: str, new: str, complaint: str) -> None:
    text = chapter.read_text(encoding="utf-8")
    assert text.count(old) == 1
    chapter.write_text(text.replace(old, new), encoding="utf-8")
    assert tool("execute.py", str(chapter)).returncode == 0
    assert complaint in "\n".join(pairs.check(chapter))


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("import warnings; warnings.warn('careful')", "stderr"),
        ("raise ValueError('no')", "a cell failed"),
        ("import sys; print(sys.prefix)", "its output holds"),
        ("object()", "its output holds"),
    ],
    ids=["warning", "error", "path", "address"],
)
def test_execution_refuses(chapter: Path, line: str, complaint: str) -> None:
    before = chapter.with_suffix(".ipynb").read_bytes()
    text = chapter.read_text(encoding="utf-8")
    chapter.write_text(text + f"\n```{{code-cell}} ipython3\n{line}\n```\n", encoding="utf-8")
    done = tool("execute.py", str(chapter))
    assert done.returncode == 1 and complaint in done.stderr
    assert chapter.with_suffix(".ipynb").read_bytes() == before


def test_executing_again_gives_the_same_bytes(executed: Path, folder: Path) -> None:
    for name in ("small.md", "widget.md"):
        shutil.copy(FIXTURES / name, folder)
    sources = [str(folder / "small.md"), str(folder / "widget.md")]
    assert tool("execute.py", *sources).returncode == 0
    first = (folder / "small.ipynb").read_bytes()
    assert first == (executed / "small.ipynb").read_bytes()
    assert b'"image/png"' in first
    assert b"widget-state+json" in (folder / "widget.ipynb").read_bytes()
    assert tool("execute.py", "--check", *sources).returncode == 0
    (folder / "small.ipynb").write_bytes(first.replace(b"rate 2.0000", b"rate 2.0001"))
    assert tool("execute.py", "--check", *sources).returncode == 1
    assert tool("regress.py", str(folder / "widget.md")).returncode == 0


def test_header_of_a_figure_survives_the_round_trip(executed: Path) -> None:
    notebook = jupytext.read(executed / "small.ipynb")
    again = jupytext.reads(jupytext.writes(notebook, "md:myst"), "md:myst")
    before, after = (
        [cell.metadata for cell in n.cells if "mystnb" in cell.metadata] for n in (notebook, again)
    )
    assert before == after and len(before) == 2
    assert after[0]["mystnb"]["image"]["alt"].startswith("One curve")


def test_stored_notebook_names_no_version_and_no_path(executed: Path) -> None:
    text = (executed / "small.ipynb").read_text(encoding="utf-8")
    notebook = json.loads(text)
    assert "version" not in notebook["metadata"]["language_info"]
    assert "jupytext_version" not in text and str(ROOT) not in text


def test_new_sources_keep_the_outputs(chapter: Path) -> None:
    before = stored(chapter)
    text = chapter.read_text(encoding="utf-8")
    chapter.write_text(text.replace("rate {rate:.4f}", "rate {rate:.5f}"), encoding="utf-8")
    assert tool("execute.py", "--sources", str(chapter)).returncode == 0
    after = stored(chapter)
    assert pairs.check(chapter) == []
    assert [c.source for c in before.cells] != [c.source for c in after.cells]
    assert [c.get("outputs") for c in before.cells] == [c.get("outputs") for c in after.cells]
    chapter.write_text(text + "\n```{code-cell} ipython3\n1 + 1\n```\n", encoding="utf-8")
    done = tool("execute.py", "--sources", str(chapter))
    assert done.returncode == 1 and "other cells" in done.stderr
