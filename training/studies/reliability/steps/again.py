"""``python -m training.studies.reliability.steps.again``: an item as JSON on standard input, its digest back."""

from __future__ import annotations

import json
import subprocess
import sys

from training.studies.reliability.steps.items import Item
from training.studies.reliability.steps.runs import run

__all__ = ["digest_elsewhere"]

_PATIENCE_S = 3600.0


def digest_elsewhere(item: Item) -> str:
    """Return the digest of an item that is run in a process of its own; what it died of where it did."""
    done = subprocess.run(
        [sys.executable, "-m", "training.studies.reliability.steps.again"], input=json.dumps(item),
        capture_output=True, text=True, timeout=_PATIENCE_S, check=False,
    )  # fmt: skip
    return done.stdout.strip() or f"exit code {done.returncode}: {done.stderr.strip()[-200:]}"


def main() -> None:
    """Answer."""
    print(run(Item(*json.load(sys.stdin))).digest)


if __name__ == "__main__":
    main()
