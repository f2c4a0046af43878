"""Which demonstrations are trained on, and which are held out."""

from collections.abc import Collection, Sequence

from flowlab.data.replay_buffer import EpisodeSlice
from flowlab.data.training_settings import DataSettings


def split_episodes(
    episodes: Sequence[EpisodeSlice], settings: DataSettings, inferred: Collection[int] = ()
) -> tuple[list[int], list[int]]:
    """Of each task the last few are held out, at most a third, and of the others the first so many are trained on.

    What is held out tells how good a policy is, so its actions are recorded ones; inferred ones are held out only of a
    task that has no others. Nothing is trained on whose scene another dataset's held-out demonstration shows.

    Args:
        episodes: All that there are.
        settings: How many of each.
        inferred: Indices of those whose actions were inferred.

    Returns:
        Indices of the episodes to train on, and of those to validate on.
    """
    train: list[int] = []
    held: list[int] = []
    for task in sorted({e.task for e in episodes}):
        of_task = [k for k, e in enumerate(episodes) if e.task == task]
        sure = [k for k in of_task if k not in inferred] or of_task
        last = len(sure) - min(settings.held_out, len(sure) // 3)
        known = {episodes[k].scene for k in sure[last:]} - {""}
        free = [k for k in of_task if k not in sure[last:] and episodes[k].scene not in known]
        train += free[: settings.demonstrations]
        held += sure[last:]
    return train, held
