"""The working copy of `make lab`: readable in JupyterLab, and independent of the repository."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbformat.sign import NotebookNotary

import execute
import lab
from common import BOOK, ROOT, chapters, toc_pages

BUILT = ROOT / "_build" / "html" / "book"


@pytest.fixture(scope="module")
def working_copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lab") / "copy"
    assert lab.main([str(folder), "--no-open"]) == 0
    return folder


def prose(path: Path) -> str:
    cells = nbformat.read(path, as_version=4).cells
    return "\n\n".join(cell.source for cell in cells if cell.cell_type == "markdown")


def test_every_chapter_is_one_notebook_and_every_page_is_there(
    working_copy: Path,
) -> None:
    files = {p.name for p in (working_copy / "book").iterdir() if p.is_file()}
    # A chapter is there once: as a notebook, without its Markdown.
    assert files == {
        lab.file_of(Path(page).name) for page in toc_pages() if "/api/" not in page
    }
    stems = [name.rpartition(".")[0] for name in files]
    assert len(stems) == len(set(stems))
    assert (working_copy / "data" / "scenarios" / "accepted.csv").is_file()
    assert (working_copy / "book" / "examples" / "own_filter.py").is_file()


def test_no_role_is_left_and_no_label_is_lost(working_copy: Path) -> None:
    n_labels = 0
    for source in chapters():
        text = prose(working_copy / "book" / f"{source.stem}.ipynb")
        # JupyterLab shows roles and directives of MyST as raw text.
        assert not lab.ROLE.search(text)
        assert "{math}" not in text
        assert "solution-" not in text
        stored = nbformat.read(source.with_suffix(".ipynb"), as_version=4)
        labels = [
            x
            for c in stored.cells
            if c.cell_type == "markdown"
            for x in lab.labels_of(c.source)
        ]
        # Each labelled equation has a number, which references name.
        assert text.count("\\tag{") == len(labels)
        n_labels += len(labels)
        figures = [
            c for c in stored.cells if c.metadata.get("mystnb", {}).get("figure")
        ]
        assert len(re.findall(r"^\*\*Fig\. [\d.]+\*\* ", text, re.M)) == len(figures)
    assert n_labels > 0


# A directive, or a role of any name
RAW = re.compile(r"^[`:]{3,}\{|\{[\w:-]+\}`", re.MULTILINE)


@pytest.fixture(scope="module")
def downloads(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the notebooks that the pages offer."""
    folder = tmp_path_factory.mktemp("downloads")
    lab.write_downloads(folder)
    return folder


def test_a_downloaded_notebook_is_read_alone(downloads: Path) -> None:
    for source in lab.downloadable():
        name = f"{source.stem}.ipynb"
        notebook = nbformat.read(downloads / name, as_version=4)
        nbformat.validate(notebook)
        assert "pip install" in notebook.cells[0].source
        text = prose(downloads / name)
        assert RAW.findall(text) == []
        # Other pages are not beside it.
        assert re.findall(r"\]\(([^)\s]*\.(?:md|ipynb)[^)\s]*)\)", text) == []
        # Nothing of the page is lost: code, outputs and ids are the stored ones.
        stored = nbformat.read(source.with_suffix(".ipynb"), as_version=4)
        cells = {cell.id: cell for cell in notebook.cells}
        for cell in stored.cells:
            if cell.cell_type == "code":
                assert cells[cell.id].source == cell.source
                assert cells[cell.id].outputs == cell.outputs


def run_alone(downloads: Path, source: Path, folder: Path) -> None:
    """Run a downloaded notebook in an empty folder; an error of a cell raises."""
    notebook = nbformat.read(downloads / f"{source.stem}.ipynb", as_version=4)
    execute.run(notebook, folder)
    # It leaves no file behind either.
    assert list(folder.iterdir()) == []


def test_a_downloaded_notebook_runs_in_an_empty_folder(
    downloads: Path, tmp_path: Path
) -> None:
    run_alone(downloads, lab.downloadable()[0], tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("source", lab.downloadable()[1:], ids=lambda s: s.stem)
def test_every_downloaded_notebook_runs_in_an_empty_folder(
    downloads: Path, tmp_path: Path, source: Path
) -> None:
    run_alone(downloads, source, tmp_path)


def test_numbers_are_those_of_the_built_book() -> None:
    pages = [ROOT / f"{page}.md" for page in toc_pages()]
    names = lab.names(pages)
    numbers = {}
    for source in chapters():
        html = (BUILT / f"{source.stem}.html").read_text(encoding="utf-8")
        # Two programs count the equations: Sphinx for the pages, `lab` for the copy.
        numbers |= re.findall(
            r'id="equation-([\w-]+)">\s*<span class="eqno">(\([\d.]+\))', html
        )
    assert {label: names.words[label] for label in numbers} == numbers
    assert len(numbers) >= len(names.equations) > 20


def test_words_for_citations_and_places() -> None:
    refs = lab.parse_file(str(BOOK / "refs.bib"), bib_format="bibtex")
    names = lab.Names()
    names.add("04-satellite-network", "Chapter 4, Satellites", "04-satellite-network")
    names.add("eq-sat-step", "(4.1)", "04-satellite-network")
    names.equations["eq-sat-step"] = "4.1"
    text = (
        "{cite:t}`clohessy1960terminal` and {cite:p}`evensen2003ensemble,vanloan1978computing`, "
        "{eq}`eq-sat-step`, {ref}`the step <eq-sat-step>`, {doc}`04-satellite-network`.\n\n"
        "```{math}\n:label: eq-sat-step\nx = 1\n```\n\n```{math}\ny = 2\n```\n"
        "[one](01-bayes-and-kalman.md)"
    )
    assert lab.plain(text, "04-satellite-network", names, refs) == (
        "[Clohessy and Wiltshire (1960)](bibliography.md) and "
        "([Evensen, 2003; Van Loan, 1978](bibliography.md)), "
        "(4.1), the step, Chapter 4, Satellites.\n\n"
        "$$\nx = 1\n\\tag{4.1}\n$$\n\n$$\ny = 2\n$$\n"
        "[one](01-bayes-and-kalman.ipynb)"
    )
    # On another page the reference becomes a link to the chapter.
    other = lab.plain("{eq}`eq-sat-step`", "notation", names, refs)
    assert other == "[(4.1)](04-satellite-network.ipynb)"


def test_outputs_are_trusted_hidden_code_is_folded_and_no_save_writes_a_second_file(
    working_copy: Path,
) -> None:
    notary = NotebookNotary(data_dir=str(working_copy / ".jupyter" / "data"))
    for path in (working_copy / "book").glob("*.ipynb"):
        notebook = nbformat.read(path, as_version=4)
        nbformat.validate(notebook)
        # Without the pairing JupyterLab cannot write a Markdown file beside the
        # notebook.
        assert "jupytext" not in notebook.metadata
        assert notary.check_signature(notebook)
        for cell in notebook.cells:
            if lab.HIDDEN & set(cell.metadata.get("tags", [])):
                assert cell.metadata["jupyter"]["source_hidden"]


def test_a_copy_is_kept_and_the_repository_is_not_written_to(
    working_copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # A reader's file must survive a second `make lab`.
    note = working_copy / "book" / "mine.txt"
    note.write_text("mine")
    assert lab.main([str(working_copy), "--no-open"]) == 0
    assert note.read_text() == "mine"
    assert "make lab LAB=" in capsys.readouterr().out
    note.unlink()
    full = tmp_path / "full"
    full.mkdir()
    (full / "thing").touch()
    # The repository, a folder around it, and one with other files are refused.
    for folder in (ROOT, ROOT.parent, BOOK, BOOK / "new", full):
        with pytest.raises(SystemExit):
            lab.main([str(folder), "--no-open"])


def wait(ask: Any, seconds: int = 240) -> Any:
    """Return an answer as soon as there is one."""
    for _ in range(seconds):
        try:
            answer = ask()
            if answer:
                return answer
        # The server does not listen yet.
        except OSError:
            pass
        time.sleep(1)
    raise AssertionError("nothing came")


@pytest.mark.slow
def test_in_jupyterlab_a_chapter_runs_and_is_saved_apart(tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    stem = "01-bayes-and-kalman"
    lab.main([str(folder), "--no-open"])
    saved = folder / "book" / f"{stem}.ipynb"
    # Outputs that are there later come from this run.
    _clear_outputs(saved)
    with socket.socket() as free:
        # Port 0 lets the system choose a free one.
        free.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{free.getsockname()[1]}"
    command = [sys.executable, "-m", "jupyterlab", f"--notebook-dir={folder / 'book'}"]
    command += ["--no-browser", "--allow-root", f"--port={address.rsplit(':')[-1]}"]
    command += ["--IdentityProvider.token=", "--expose-app-in-browser"]
    # The state of the repository before and after must be the same.
    before = subprocess.run(
        ["git", "status", "--short"], cwd=ROOT, capture_output=True
    ).stdout
    server = subprocess.Popen(
        command, env=lab.settings(folder), stderr=subprocess.DEVNULL
    )
    try:
        wait(lambda: urllib.request.urlopen(f"{address}/api"))
        _run_all(address, stem, tmp_path)
    finally:
        server.terminate()
        server.wait()
    after = subprocess.run(
        ["git", "status", "--short"], cwd=ROOT, capture_output=True
    ).stdout
    assert before == after
    assert not saved.with_suffix(".md").exists()
    cells = [
        c for c in nbformat.read(saved, as_version=4).cells if c.cell_type == "code"
    ]
    # All cells ran, once and in order, and the notebook was saved.
    assert [c.execution_count for c in cells] == list(range(1, len(cells) + 1))
    assert not [o for c in cells for o in c.outputs if o.output_type == "error"]


def _clear_outputs(path: Path) -> None:
    """Remove the stored outputs, so that later outputs come from a kernel."""
    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = []
            cell.execution_count = None
    nbformat.write(notebook, path)


def _run_all(address: str, stem: str, scratch: Path) -> None:
    """Open a chapter, run all its cells, move its sliders, save it."""
    from test_browser import chromium

    command = (
        "const done = arguments[1]; jupyterapp.commands.execute(arguments[0])"
        ".then(() => done('done'), e => done(String(e)));"
    )
    with chromium(scratch / "profile") as driver:
        driver.set_script_timeout(600)
        # Newer browsers give a page without a window no focus, and JupyterLab runs the notebook
        # that has it.
        focus = {"enabled": True}
        driver.execute_cdp_cmd("Emulation.setFocusEmulationEnabled", focus)
        driver.get(f"{address}/lab/tree/{stem}.ipynb")
        # Cells that are run before the kernel is there make JupyterLab ask for one.
        ready = (
            "return window.jupyterapp?.shell.currentWidget?.sessionContext?.session?.kernel"
            "?.status === 'idle'"
        )
        wait(lambda: driver.execute_script(ready))
        assert driver.execute_async_script(command, "notebook:run-all-cells") == "done"
        moved = driver.execute_script(
            "return [...document.querySelectorAll('[data-frames]')].map(r => {"
            "const [i, m] = [r.querySelector('input'), r.querySelector('img')]; const was = m.src;"
            "i.value = Number(i.value) ? 0 : 1; i.dispatchEvent(new Event('input'));"
            "return m.src !== was; })"
        )
        assert moved
        assert all(moved)
        assert driver.execute_async_script(command, "docmanager:save") == "done"
