"""Words from docstrings and help, as Markdown."""

import re


def one_line(text: str) -> str:
    """Text without line breaks that can stand in a table: names as code, and no column, link or tag of its own."""
    text = re.sub(r":\w+:`~?(?:[\w.]+\.)?(\w+)`", r"`\1`", " ".join(text.split())).replace("``", "`")
    parts = text.replace("|", r"\|").split("`")
    return "`".join(part if k % 2 else re.sub(r"([*\[<_])", r"\\\1", part) for k, part in enumerate(parts))


def as_code(text: str) -> str:
    """An option or a value, as code in a table."""
    return "`" + text.replace("|", r"\|") + "`"
