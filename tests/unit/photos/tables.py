"""Tables of formats in docs/odd-inputs.md, which tests make."""

from pathlib import Path


def check_table(name, rows):
    """The page has the table, of which the first row is the head."""
    head, *others = ["| " + " | ".join(row) + " |\n" for row in rows]
    table = f"<!-- {name}: begin -->\n{head}{'|---' * len(rows[0])}|\n{''.join(others)}<!-- {name}: end -->\n"
    page = Path(__file__).parents[3] / "docs" / "odd-inputs.md"
    assert table in page.read_text(encoding="utf-8"), f"the table in {page.name} is to be:\n{table}"
