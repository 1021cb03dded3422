"""``mecanum doctor`` on the command line."""

from __future__ import annotations

import json
from dataclasses import asdict

import typer

from training.runs.options import Json

__all__ = ["doctor"]


def doctor(as_json: Json = False) -> None:
    """Look what works on this machine, and say what to do where something does not.

    Exits with 0 where `mecanum explore` has all it needs, else with 1. A line begins with ok, with FAILS, or
    with - where something is missing that can be done without.

    \b
    Examples:
      mecanum doctor
      mecanum doctor --json
    """  # noqa: D301
    from training.doctor import examine

    findings = examine()
    ok = all(finding.ok for finding in findings)
    if as_json:
        print(json.dumps({"ok": ok, "findings": [asdict(finding) for finding in findings]}, ensure_ascii=False))
    else:
        for finding in findings:
            mark = "ok" if finding.works else "-" if finding.ok else "FAILS"
            remedy = f"\n{'':<18}{finding.remedy}" if finding.remedy else ""
            print(f"{mark:<7}{finding.name:<11}{finding.found}{remedy}")
    raise typer.Exit(0 if ok else 1)
