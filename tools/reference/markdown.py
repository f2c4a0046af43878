"""Words from docstrings and help, as Markdown."""

import re


def one_line(text: str) -> str:
    """Text without line breaks that can stand in a table: names as code, and no column of its own."""
    text = re.sub(r":\w+:`~?(?:[\w.]+\.)?(\w+)`", r"`\1`", " ".join(text.split()))
    return text.replace("``", "`").replace("|", r"\|").replace("<", "&lt;").replace("*", r"\*")
