"""Options that several commands and studies share."""

from __future__ import annotations

from typing import Annotated

import typer

__all__ = ["Json", "Workers"]

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output, nothing else.")]
Workers = Annotated[int | None, typer.Option(min=1, max=1024, help="Processes.  [default: one a core]")]
