"""Let nbval run a cell as Jupyter does, compare pictures, and connect to kernels by files.

nbval sends ``store_history=False``. IPython then shows the value of a last line that ends in ``;``,
which Jupyter does not store, and the cell fails. Also, nbval does not compare pictures: a missing
or different one would pass.
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
    """Patch nbval, if it runs."""
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
        """Compare texts exactly, by nbval, and pictures by their pixels."""
        texts = (without_pictures(test), without_pictures(ref), skip_compare)
        if not compare_texts(cell, *texts):
            return False
        picture_differences = differences(ref, test)
        cell.comparison_traceback += picture_differences
        return not picture_differences

    nbval.kernel.KernelManager = Manager
    nbval.kernel.RunningKernel.execute_cell_input = _execute_cell_input
    IPyNbCell.compare_outputs = compare_outputs
