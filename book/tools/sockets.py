"""Kernels that are reached through files instead of ports.

A kernel's ports are chosen by the process that starts it and opened a second later by the kernel.
In between, another process may get the same port, and then two chapters read each other's messages.
A file with a unique name cannot be shared.
"""

from __future__ import annotations

import tempfile
import uuid
from typing import Any

from jupyter_client.manager import AsyncKernelManager, KernelManager


class _Files:
    """Connection by files, for both managers; the first base class."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        # Not beside Jupyter's own files: a socket's path has at most a hundred characters.
        path = f"{tempfile.gettempdir()}/kernel-{uuid.uuid4().hex}"
        super().__init__(*arguments, transport="ipc", ip=path, **options)


class Manager(_Files, KernelManager):
    """A manager for callers that wait."""


class AsyncManager(_Files, AsyncKernelManager):
    """A manager for callers that do not."""
