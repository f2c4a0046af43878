"""Write a report of evaluations: one page to read, and the numbers behind it as JSON and CSV."""

import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from flowlab.benchmark.robot_trials import RobotTrial
from flowlab.benchmark.summary import Summary
from flowlab.errors import DataError
from flowlab.evaluation.results import PolicyResult
from flowlab.files import remove_leftovers, told_when_unwritable, write_atomically, write_json
from flowlab.report import figures
from flowlab.report.csv_files import EPISODE_COLUMNS, REPORT_COLUMNS, csv_text, episode_rows, report_rows
from flowlab.report.page import render_page
from flowlab.report.tables import Table, robot_trial_tables
from flowlab.version import __version__

PAGE = "report.html"


def write_report(
    folder: Path,
    summary: Summary,
    results: Sequence[PolicyResult],
    *,
    videos: Sequence[Path] = (),
    robot_trials: Sequence[RobotTrial] = (),
) -> Path:
    """Write ``report.html``, which holds its figures, and beside it ``report.json``, ``report.csv``, ``episodes.csv``
    and the figures as PNG.

    Each file is replaced in one step; the same results, in any order, give the same bytes.

    Args:
        folder: Where to write.
        summary: Of the results, from :func:`flowlab.benchmark.summary.summarize`.
        results: Whose episodes are listed.
        videos: Linked from the page.
        robot_trials: Trials on a robot that somebody scored.

    Returns:
        The page.

    Raises:
        DataError: There are neither results nor such trials, or the folder cannot be written.
    """
    if not results and not robot_trials:
        raise DataError("there is nothing to report; evaluate a policy first, with: flowlab eval RUN")
    with told_when_unwritable(folder, "choose another folder or make room"):
        return _write(folder, summary, results, videos, robot_trial_tables(robot_trials))


def _write(
    folder: Path, summary: Summary, results: Sequence[PolicyResult], videos: Sequence[Path], robot_tables: list[Table]
) -> Path:
    """Write all of it; what an earlier one that was killed left behind goes."""
    folder.mkdir(parents=True, exist_ok=True)
    remove_leftovers(folder)
    drawn = figures.draw_figures(folder / figures.FOLDER, summary)
    numbers = summary.to_json()
    values = {
        "flowlab": __version__,
        "paper": numbers.pop("paper"),
        "summary": numbers,
        "scored": [{"title": t.title, "columns": t.columns, "rows": t.rows} for t in robot_tables],
    }
    write_json(folder / "report.json", {key: values[key] for key in ("flowlab", "summary", "paper", "scored")})
    write_atomically(folder / "report.csv", csv_text(REPORT_COLUMNS, report_rows(summary)))
    write_atomically(folder / "episodes.csv", csv_text(EPISODE_COLUMNS, episode_rows(results)))
    links = [(video.name, quote(Path(os.path.relpath(video, folder)).as_posix())) for video in videos]
    write_atomically(folder / PAGE, render_page(summary, drawn, links, robot_tables))
    return folder / PAGE
