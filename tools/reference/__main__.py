"""``make reference``: pages of every command and every setting, from the code itself.

They are kept in the repository, so that they can be read there, and ``tests/docs/test_reference.py`` holds that they
are what the code says.
"""

from pathlib import Path

from commands_page import commands_page
from settings_page import settings_page

DOCS = Path(__file__).parents[2] / "docs"
PAGES = {"commands.md": commands_page, "settings.md": settings_page}


def main() -> None:
    """Write the pages."""
    for name, page in PAGES.items():
        (DOCS / name).write_text(page())
        print(DOCS / name)


if __name__ == "__main__":
    main()
