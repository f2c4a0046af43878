"""Small things about text that many rooms need."""

import hashlib
import re
import reprlib

from flowlab.limits import MAX_SHOWN

_UNPRINTABLE = re.compile(
    r"[\x00-\x09\x0b-\x1f\x7f-\x9f\xad\u061c\u180e\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb"
    r"\ud800-\udfff\U000e0000-\U000e007f]"
)
"""Controls, terminal escapes, turns of the writing direction, what is not seen, halves of characters; not the end of a
line, nor what joins letters."""
_KEPT = "\n\u200c\u200d"
"""The end of a line, and what joins letters."""
_MARKUP = re.compile(r"[\\`*_\[\]<>|&~$#!]")
_LONGEST_NAME = 150
"""Bytes; file systems take 255, and a file in the making has a longer name."""


def natural_key(text: str) -> list[str | int]:
    """What to sort names by so that take-2 comes before take-10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d{1,18})", text)]


def printable(text: str) -> str:
    """Text from a file, fit for a terminal: what could move the cursor, is not seen, is no character or
    only looks like a space is escaped."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in _KEPT else ascii(c)[1:-1] for c in text)


def one_line(text: str) -> str:
    """Text from a file as a line of a terminal, a page or a figure: no end of a line in it makes another."""
    return printable(text).replace("\n", " ")


def counted(number: int, one: str, many: str = "") -> str:
    """How many there are of something, as people say it: 1 episode, 2,000 episodes."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def markdown(text: str) -> str:
    """Text from a file as Markdown shows it, in a table too: none of it is markup."""
    return _MARKUP.sub(r"\\\g<0>", one_line(text))


def file_name(text: str) -> str:
    """A name for a file that tells what is in it: the text itself where that is a plain name, else one like it."""
    if is_plain_name(text):
        return text
    like = re.sub(r"[^\w.-]+", "-", text, flags=re.ASCII).strip("-.")[: _LONGEST_NAME // 2]
    return f"{like}-{hashlib.sha256(text.encode('utf-8', 'surrogatepass')).hexdigest()[:8]}".lstrip("-")


def shown(value: object, limit: int = MAX_SHOWN) -> str:
    """A value from a file as an error shows it: text in quotes, else as Python writes it; in one line, and cut."""
    if isinstance(value, str):
        return f"'{cut(value, limit)}'"
    short = reprlib.Repr()  # makes no more than it shows; aliases of YAML can make a value huge
    short.maxlevel, short.maxstring, short.maxother = 3, limit, limit
    try:
        return cut(short.repr(value), limit)
    except ValueError:  # Python writes no integer of more than 4,300 digits
        return "a number of thousands of digits"


def cut(text: str, limit: int = MAX_SHOWN) -> str:
    """Text from a file or of a library, as an error repeats it: printable, in one line, no longer than that."""
    line = printable(text[: limit + 1]).replace("\n", " ")
    return line if len(line) <= limit else line[:limit] + "..."


def is_path_inside(name: str) -> bool:
    """Whether text names a file in or below a folder, without leading out of it."""
    parts = name.split("/")
    return bool(name) and not name.startswith("/") and ".." not in parts and not _UNPRINTABLE.search(name)


def is_plain_name(name: str) -> bool:
    """Whether text can name a file in a folder, and nothing outside of it."""
    fits = 0 < len(name.encode("utf-8", "surrogatepass")) <= _LONGEST_NAME
    return fits and not name.startswith(".") and not _UNPRINTABLE.search(name) and not re.search(r"[/\\\n]", name)
