"""Write the semantic-loss matrix as Markdown and HTML."""

from __future__ import annotations

from functools import cache
from importlib import resources

import jinja2

from pytest_twin.asset.changes import escape_markdown
from pytest_twin.asset.loss.matrix import Matrix, Row


def features(matrix: Matrix) -> list[str]:
    """Return all features, in the order of the rows."""
    return list(dict.fromkeys(row.feature for held in matrix.conversions for row in held.rows))


def difference_text(row: Row) -> str:
    """Return the measured difference and its tolerance as text."""
    if row.difference is None or row.tolerance is None:
        return ""
    return f"{row.difference:.2g} {row.unit}, kept up to {row.tolerance:.2g}"


def markdown(matrix: Matrix) -> str:
    """Return a table of verdicts and one table for each conversion as Markdown."""
    say = escape_markdown
    lines = [f"# Semantic loss of {say(matrix.robot)}", ""]
    lines += [f"Fails: {say(line)}" for line in matrix.critical] + [""] * bool(matrix.critical)
    names = [say(f"{c.source} to {c.target}") for c in matrix.conversions]
    lines += ["| feature | " + " | ".join(names) + " |", "|" + " --- |" * (len(names) + 1)]
    for feature in features(matrix):
        cells = []
        for held in matrix.conversions:
            row = next((row for row in held.rows if row.feature == feature), None)
            cells.append("-" if row is None else _verdict(row))
        lines.append(f"| {feature} | " + " | ".join(cells) + " |")
    for conversion in matrix.conversions:
        lines += ["", f"## {say(f'{conversion.source} to {conversion.target}')}", ""]
        if conversion.problem:
            lines.append(say(conversion.problem))
            continue
        lines += [f"Read back by {say(conversion.engine)}.", ""]
        lines += ["| feature | verdict | from | to | compared | measured |", "|" + " --- |" * 6]
        for row in conversion.rows:
            columns = (
                row.feature,
                _verdict(row),
                row.before,
                row.after,
                row.comparison,
                difference_text(row),
            )
            lines.append("| " + " | ".join(say(cell) for cell in columns) + " |")
        for row in conversion.rows:
            if row.items:
                lines += ["", f"### {row.feature}: {_verdict(row)}", ""]
                lines += ["| name | verdict | from | to |", "|" + " --- |" * 4]
                lines += [
                    "| "
                    + " | ".join(
                        say(cell or "-")
                        for cell in (item.name, item.verdict, item.before, item.after)
                    )
                    + " |"
                    for item in row.items
                ]
    return "\n".join(lines) + "\n"


def _verdict(row: Row) -> str:
    return f"{row.verdict}, FAILS" if row.critical else row.verdict


def html(matrix: Matrix) -> str:
    """Return the matrix as a self-contained HTML page."""
    return _template().render(
        matrix=matrix,
        features=features(matrix),
        measured=difference_text,
        row_of=lambda held, feature: next(
            (row for row in held.rows if row.feature == feature), None
        ),
    )


@cache
def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    text = resources.files("pytest_twin.asset.loss").joinpath("loss.html.j2").read_text("utf-8")
    return environment.from_string(text)
