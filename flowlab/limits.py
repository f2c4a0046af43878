"""How much of a stranger's file is taken in: checked on its size and header, before memory is taken."""

MAX_TEXT_BYTES = 64 << 20
"""Of a JSON, CSV or text file; a manifest of ten thousand recordings has 5 MB."""
MAX_YAML_BYTES = 1 << 18
"""Of a recipe, a profile, a ``recording.yaml``: they are written by hand."""
MAX_YAML_NODES = 100_000
"""Values in a YAML file, those that aliases repeat counted each time."""
MAX_NESTING = 64
"""Lists in lists, in JSON and YAML."""
MAX_PIXELS = 64_000_000
"""Of a picture: 8000 x 8000."""
MAX_PICTURE_BYTES = 512 << 20
"""Of a file that holds a picture; uncompressed formats are large."""
MAX_ARRAY_BYTES = 64 << 30
"""Of an array that is mapped, not read: a long recording's color pictures."""
MAX_LOADED_BYTES = 1 << 30
"""Of an array that is read into memory at once."""
MAX_SHOWN = 200
"""Characters of a value that an error shows."""
MAX_WIDTH = 100_000
"""Numbers of a state or an action."""
