"""Makes nbval run a cell as Jupyter does.

nbval sends ``store_history=False``; IPython then shows the value of a last line that ends in ``;``,
and the cell fails against an output that Jupyter stored without it.
"""

from __future__ import annotations

from typing import Any

from nbval.kernel import RunningKernel


def _execute_cell_input(kernel: Any, cell_input: str, allow_stdin: bool | None = None) -> Any:
    return kernel.kc.execute(
        cell_input, store_history=True, allow_stdin=allow_stdin, stop_on_error=False
    )


RunningKernel.execute_cell_input = _execute_cell_input
