"""Lists of names in sentences."""

from collections.abc import Sequence


def list_names(names: Sequence[str], most: int) -> str:
    """Return the first few names with commas, and how many more there are.

    Args:
        names: any number of them.
        most: how many are named.
    """
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{more}"
