"""Options that several commands and studies share."""

from __future__ import annotations

from typing import Annotated

import typer

__all__ = ["Backends", "Json", "Seed", "Seeds", "Workers"]

Backends = Annotated[str, typer.Option(help="SLAM backends, separated by commas.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output, nothing else.")]
Seed = Annotated[int, typer.Option(min=0)]
Seeds = Annotated[str, typer.Option(help="3, 0:9 (both included) or 1,4,7.")]
Workers = Annotated[int | None, typer.Option(min=1, max=1024, help="Processes.  [default: one a core]")]
