"""Small things about text that many rooms need."""

import re


def natural_key(text: str) -> list[str | int]:
    """What to sort names by so that take-2 comes before take-10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", text)]
