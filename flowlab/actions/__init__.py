"""Actions of films: the gripper's path read off clouds and tracks, and actions inferred from it."""
