"""How far a point must go to count as moving. Each limit belongs to a span of time, and stands here once."""

STILL_STEP_M = 1e-4
"""Less than this in one step [m] is standing still."""
MOVING_IN_PLAN_M = 0.005
"""Farther than this from where it is now [m], within the steps of a plan or of a training window."""
MOVING_IN_EPISODE_M = 0.01
"""Farther than this from where it was first [m], at any step of an episode."""
MOVING_IN_RECORDING_M = 0.02
"""The same where labels of recordings are graded [m]."""
