"""``python -m flowlab``."""

from flowlab.cli import main

if __name__ == "__main__":
    main()
