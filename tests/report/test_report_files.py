"""The files of a report: read back from CSV and JSON."""

import csv
import json
import random
from pathlib import Path

import pytest
from policy_results import EXAMPLE, evaluation, flow, outcomes, result, wilson
from report_pages import write

from flowlab.benchmark.paper import MAIN, QUERY_POINTS
from flowlab.benchmark.summary import summarize
from flowlab.errors import DataError
from flowlab.report.figures import success_panels


def read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_line_for_every_label_and_task(tmp_path: Path) -> None:
    write(tmp_path, EXAMPLE)
    rows = {(r["label"], r["task"]): r for r in read_csv(tmp_path / "report.csv")}
    assert len(rows) == 5
    row = rows["dp3", "push"]
    assert [row[k] for k in ("difficulty", "successes", "episodes", "success")] == ["hard", "4", "10", "0.4"]
    assert [row[k] for k in ("successes_dp3", "mean_steps_to_success", "broke_down")] == ["3", "25.0", "1"]
    assert (float(row["low"]), float(row["high"])) == pytest.approx(wilson(4, 10), abs=1e-6)
    assert (row["training_steps"], row["training_cpu_s"]) == ("1000", "120.0")


def test_a_line_for_every_episode(tmp_path: Path) -> None:
    early = evaluation(500, "sf")
    results = [*EXAMPLE, result("mba", outcomes("push", "sb"), evaluations=[early])]
    write(tmp_path, results)
    rows = read_csv(tmp_path / "episodes.csv")
    assert len(rows) == sum(len(e.outcomes) for r in results for e in r.evaluations)
    found = {(r["result"], r["step"], r["n_action_steps"], r["task"], r["seed"], r["episode"]): r for r in rows}
    for r in results:
        for e in r.evaluations:
            for o in e.outcomes:
                row = found[r.name, str(e.step), str(e.n_action_steps), o.task, str(o.seed), str(o.episode)]
                assert row["label"] == r.label
                assert (row["success"], row["success_dp3"]) == (str(int(o.success)), str(int(o.success_dp3)))
                assert (int(row["steps"]), int(row["scene_seed"]), row["note"]) == (o.steps, o.scene_seed, o.note)
                assert row["ade_mm"] == ("" if o.flow is None else str(o.flow.ade_mm))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_the_same_results_give_the_same_bytes(tmp_path: Path) -> None:
    results = [*EXAMPLE, result("mba", outcomes("push", "bsb"), outcomes("assembly", "sb"))]
    mixed = [
        r.model_copy(
            update={"evaluations": tuple(e.model_copy(update={"outcomes": e.outcomes[::-1]}) for e in r.evaluations)}
        )
        for r in random.Random(0).sample(results, len(results))
    ]
    write(tmp_path / "one", results)
    write(tmp_path / "two", mixed)
    one, two = contents(tmp_path / "one"), contents(tmp_path / "two")
    assert one.keys() == {
        "report.json", "report.csv", "episodes.csv", "report.html", "figures/success.png", "figures/flow.png",
    }  # fmt: skip
    assert one == two


def test_the_json_holds_the_summary(tmp_path: Path) -> None:
    write(tmp_path, EXAMPLE)
    values = json.loads((tmp_path / "report.json").read_text())
    told = summarize(EXAMPLE).to_json()
    paper = told.pop("paper")
    assert (values["summary"], values["paper"]) == (told, paper)
    assert {"strides", "broken"} <= told.keys(), "as they have always been called"
    assert values["flowlab"]
    assert [table["source"] for table in values["paper"]] == [MAIN.source, QUERY_POINTS.source]


def test_a_new_report_replaces_all_of_an_old_one(tmp_path: Path) -> None:
    write(tmp_path, [result("fdp", outcomes("push", "sss", error=flow(1)), evaluations=[evaluation(500, "sf")])])
    assert {p.name for p in (tmp_path / "figures").iterdir()} == {"success.png", "curves.png", "flow.png"}
    write(tmp_path, [result("dp3", outcomes("push", "sss"))])
    assert {p.name for p in (tmp_path / "figures").iterdir()} == {"success.png"}
    assert len(read_csv(tmp_path / "episodes.csv")) == 3


def test_nothing_is_no_report(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nothing to report; evaluate a policy first, with: flowlab eval RUN"):
        write(tmp_path / "r", [])
    assert not (tmp_path / "r").exists()


def test_the_figure_has_means_of_the_same_tasks_only() -> None:
    medium, hard = success_panels(summarize([*EXAMPLE, result("mba", outcomes("push", "s"))]))
    assert (medium.heading, list(medium.rows), medium.mean) == ("medium (1 of 11)", ["hammer"], {})
    assert (hard.heading, list(hard.rows)) == ("hard (2 of 6)", ["assembly", "push"])
    assert hard.rows["push"]["fdp"].share == 0.7
    assert hard.rows["push"]["fdp"].paper == 0.617
    assert hard.rows["push"]["dp3"].paper is None
    assert {label: (m.share, m.paper) for label, m in hard.mean.items()} == {"dp3": (0.325, None), "fdp": (0.6, None)}
    all_six = ("assembly", "hand-insert", "pick-out-of-hole", "pick-place", "push", "push-back")
    (hard,) = success_panels(summarize([result("fdp", *(outcomes(task, "sf") for task in all_six))]))
    assert (hard.mean["fdp"].share, hard.mean["fdp"].paper) == (0.5, 0.556)
