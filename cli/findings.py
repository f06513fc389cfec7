"""Findings for people: what was looked at, how bad it is, and a remedy beside it."""

from collections.abc import Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from robotctl.hal.host import Finding, Level

_COLOURS = {Level.OK: "green", Level.WARN: "yellow", Level.FAIL: "bold red"}


def print_findings(console: Console, findings: Sequence[Finding], title: str = "") -> None:
    """Print findings as a table, those of one area together. Prints nothing if there are none."""
    if not findings:
        return
    table = Table(title=title or None, show_lines=False)
    for heading in ("", "what", "", "found"):
        table.add_column(heading, overflow="fold")
    area = ""
    for finding in findings:
        if area not in ("", finding.area):
            table.add_section()
        shown = finding.area if finding.area != area else ""
        area = finding.area
        text = escape(finding.text) + (f"\n[dim]try: {escape(finding.remedy)}[/]" if finding.remedy else "")
        colour = _COLOURS[finding.level]
        table.add_row(shown, escape(finding.name), f"[{colour}]{finding.level}[/]", text)
    console.print(table)
