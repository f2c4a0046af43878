"""How much of a stranger's file is taken in: checked on its size and header, before memory is taken."""

MAX_TEXT_BYTES = 64 << 20
"""Of a JSON, CSV or text file; a manifest of ten thousand recordings has 5 MB."""
MAX_YAML_BYTES = 1 << 18
"""Of a recipe, a profile, a ``recording.yaml``: they are written by hand."""
MAX_YAML_NODES = 100_000
"""Values in a YAML file, those that aliases repeat counted each time."""
MAX_FILES = 1_000_000
"""Of a recording: ten hours of pictures of color and depth have two million, and nobody labels these as one."""
MAX_NESTING = 64
"""Lists in lists, in JSON and YAML."""
MAX_PIXELS = 64_000_000
"""Of a picture: 8000 x 8000."""
MAX_DEPTH_PIXELS = 16_000_000
"""Of a depth picture that is moved to the color camera, which takes 70 bytes a pixel."""
MAX_SCANS = 100
"""Passes over a JPEG; a progressive one has about ten."""
MAX_PICTURE_BYTES = 512 << 20
"""Of a file that holds a picture; uncompressed formats are large."""
MAX_ARRAY_BYTES = 64 << 30
"""Of an array that is mapped, not read: a long recording's color pictures."""
MAX_LOADED_BYTES = 1 << 30
"""Of an array that is read into memory at once."""
MAX_WEIGHTS_BYTES = 8 << 30
"""Of a file of a network's weights."""
MAX_CHUNKS = 1_000_000
"""Of an array; each is a file."""
MAX_CHUNK_BYTES = 256 << 20
"""That a compressed part of a ROS recording may unpack to."""
MAX_READER_BYTES = 1 << 30
"""Of memory that the index or a message of a ROS recording may take."""
MAX_UNPACKING = 50
"""Bytes that a compressed file may unpack to for each of its own, where they are more than ``MAX_LOADED_BYTES``."""
MAX_CALIBRATION_BYTES = 1 << 20
"""Of a pickled calibration: a matrix of 16 numbers for each of some cameras."""
MAX_SHOWN = 200
"""Characters of a value that an error shows."""
MAX_WIDTH = 100_000
"""Numbers of a state or an action."""
MAX_TABLE_ROWS = 10_000_000
"""Of a Parquet file, which holds the steps of many episodes."""
MAX_HELPER_BYTES = 6 << 30
"""Of memory that a process may take in which files of strangers are unpacked."""
