"""When an episode counts as solved: by flowlab after any step, by DP3's runner only where it looks."""

from collections.abc import Sequence

_DP3_CHECKED_STEPS = 2
"""Of the executed steps of a plan, DP3's runner keeps the success of the last so many."""


def solved_for_dp3(success: Sequence[bool]) -> bool:
    """Whether DP3's runner would see that the task is solved.

    Args:
        success: Whether the task counted as solved after each executed step of one plan.

    Returns:
        Whether it did after one of the last two of them.
    """
    return any(success[-_DP3_CHECKED_STEPS:])
