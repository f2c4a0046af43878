"""``flowlab viz``."""

from pathlib import Path

import click

from flowlab.cli.console import echo, json_option, print_json, quiet_option
from flowlab.cli.paths import PATH


@click.command()
@click.argument("source", type=PATH)
@click.option(
    "--episode",
    default=0,
    show_default=True,
    help="Position in the order of `flowlab info`: by task, then seed; of a RUN, the episode of the seed.",
)
@click.option("--task", help="Count episodes within this task; of a RUN, the task to try.")
@click.option("--seed", type=click.IntRange(min=0), help="Of a RUN: evaluation seed  [0].")
@click.option("--rejects", is_flag=True, help="Count among what was kept out of the dataset, and say why it was.")
@click.option("--save", type=PATH, help="Write a Rerun recording (.rrd) here.")
@click.option("--png", type=PATH, help="Draw a still here.")
@click.option("--mp4", type=PATH, help="Write a film of the pictures here, tracks drawn in.")
@click.option("--fps", type=click.FloatRange(min=0.1, max=240), help="Frames a second of the film [real time].")
@quiet_option
@json_option
def viz(
    source: Path,
    episode: int,
    task: str | None,
    seed: int | None,
    rejects: bool,
    save: Path | None,
    png: Path | None,
    mp4: Path | None,
    fps: float | None,
    as_json: bool,
) -> None:
    """Draw an episode: cloud, query points, their tracks over time, and where a policy predicted them.

    \b
      flowlab viz data/pour --episode 3 --mp4 pour.mp4
      flowlab viz data/pour --rejects --png why.png
      flowlab viz runs/push-fdp --task push --seed 3

    SOURCE is a dataset, or a RUN of `flowlab train` (or one of its checkpoints), which tries the episode that
    `flowlab eval` gives this number. With none of --save, --png and --mp4, a recording is written beside you.

    Tracks that were estimated are colored by their stated error σ: turquoise below 5 mm, yellow below 10, orange below
    20, red below 50, purple from there on. From 20 mm on, trails are faint, and a circle of radius σ is drawn around
    the point. A disc is in sight, a ring hidden, a cross filled in. Exact tracks are colored by what they lie on.
    """
    from flowlab.errors import UsageError
    from flowlab.report.episode_view import view_episode
    from flowlab.text import file_name

    if fps is not None and mp4 is None:
        raise UsageError("--fps is about the film; give --mp4 FILE too")
    view = view_episode(source, episode, task=task, seed=seed, rejects=rejects)
    if save is None and png is None and mp4 is None:
        save = Path(file_name(f"{view.episode.task}-{view.episode.seed:06d}") + ".rrd")
    if view.note and not as_json:
        echo(f"{view.name} was {view.note}")
    if png is not None:
        view.write_png(png)
    if mp4 is not None:
        view.write_mp4(mp4, fps=fps)
    if save is not None:
        view.write_rrd(save)
    written = {"png": png, "mp4": mp4, "rrd": save}
    if as_json:
        about = {"episode": view.name, "task": view.episode.task, "seed": view.episode.seed, "note": view.note or None}
        print_json(about | {kind: None if path is None else str(path) for kind, path in written.items()})
        return
    for kind, path in written.items():
        if path is not None:
            echo(f"{view.name}: {path}" + (f"; open it with: rerun {path}" if kind == "rrd" else ""))
