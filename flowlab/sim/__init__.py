"""MetaWorld: tasks, experts, rendering without OpenGL, and the exact motion of every surface point."""
