"""Which demonstrations are trained on, and which are held out."""

from collections.abc import Sequence

from flowlab.data.replay_buffer import EpisodeSlice
from flowlab.data.training_settings import DataSettings


def split_episodes(episodes: Sequence[EpisodeSlice], settings: DataSettings) -> tuple[list[int], list[int]]:
    """Of each task the last few are held out, at most a third, and of the others the first so many are trained on.

    Args:
        episodes: All that there are.
        settings: How many of each.

    Returns:
        Indices of the episodes to train on, and of those to validate on.
    """
    train: list[int] = []
    held: list[int] = []
    for task in sorted({e.task for e in episodes}):
        of_task = [k for k, e in enumerate(episodes) if e.task == task]
        last = len(of_task) - min(settings.held_out, len(of_task) // 3)
        train += of_task[:last][: settings.demonstrations]
        held += of_task[last:]
    return train, held
