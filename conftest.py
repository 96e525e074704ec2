"""Makes nbval run a cell as Jupyter does, compare its pictures, and open no port.

nbval sends ``store_history=False``; IPython then shows the value of a last line that ends in ``;``,
and the cell fails against an output that Jupyter stored without it. And it compares no picture: one
that was removed or exchanged passes.
"""

from __future__ import annotations

from typing import Any

import pytest


def _execute_cell_input(
    kernel: Any, cell_input: str, allow_stdin: bool | None = None
) -> Any:
    return kernel.kc.execute(
        cell_input, store_history=True, allow_stdin=allow_stdin, stop_on_error=False
    )


def pytest_configure(config: pytest.Config) -> None:
    """Nothing to change, or to import, where no notebook is run."""
    if not config.getoption("nbval", False):
        return
    import nbval.kernel
    from nbval.plugin import IPyNbCell

    from pictures import differences, without_pictures
    from sockets import Manager

    compare_texts = IPyNbCell.compare_outputs

    def compare_outputs(
        cell: Any, test: Any, ref: Any, skip_compare: Any = None
    ) -> bool:
        """Texts to the letter, by nbval; pictures as a reader sees them."""
        texts = (without_pictures(test), without_pictures(ref), skip_compare)
        if not compare_texts(cell, *texts):
            return False
        found = differences(ref, test)
        cell.comparison_traceback += found
        return not found

    nbval.kernel.KernelManager = Manager
    nbval.kernel.RunningKernel.execute_cell_input = _execute_cell_input
    IPyNbCell.compare_outputs = compare_outputs
