"""Reports say what the episodes say: counted by hand here, read back from CSV, JSON and the page."""

import base64
import csv
import json
import math
import random
from collections.abc import Iterable, Sequence
from fractions import Fraction
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flowlab.benchmark.paper import MAIN, QUERY_PLACES, QUERY_POINTS, compare_with_paper, differences, paper_share
from flowlab.benchmark.results import Evaluation, PolicyResult, TrainingRecord
from flowlab.benchmark.robot_trials import RobotTrial
from flowlab.benchmark.summary import ALL, pool_flow, summarize
from flowlab.errors import DataError
from flowlab.evaluation.results import EpisodeResult, RolloutFlowError
from flowlab.evaluation.trials import Trial
from flowlab.report.html import success_panels, success_rows, write_report

SETTINGS: dict[str, Any] = {
    "n_action_steps": 8,
    "motion": {"flow_representation": "per-query", "condition": "one-step"},
    "action": {"kind": "mlp"},
    "batch": {"shift_m": 0.1, "turn_deg": 20.0},
}


def flow(ade: float, *, pairs: int = 100, ends: int = 10, still: int = 50, **changes: float) -> RolloutFlowError:
    values = {
        "ade_mm": ade, "zero_ade_mm": 3 * ade, "fde_mm": 2 * ade, "zero_fde_mm": 5 * ade, "apd": 0.6, "zero_apd": 0.3,
        "average_jaccard": 0.5, "zero_average_jaccard": 0.2, "still_mm": 1.0,
    }  # fmt: skip
    return RolloutFlowError(pairs=pairs, ends=ends, still_pairs=still, **(values | changes))


def outcomes(
    task: str, solved: str, *, seed: int = 0, first: int = 0, error: RolloutFlowError | None = None
) -> list[EpisodeResult]:
    """One for each letter: ``s`` solved, ``l`` solved but lost when DP3's runner looks, ``f`` failed, ``b`` broke down.
    The k-th solved episode takes 10 * k steps."""
    made: list[EpisodeResult] = []
    for k, letter in enumerate(solved):
        won = letter in "sl"
        trial = Trial(task, seed, first + k)
        made.append(
            EpisodeResult(
                task=task,
                seed=seed,
                episode=first + k,
                scene_seed=trial.scene_seed,
                success=won,
                success_dp3=letter == "s",
                steps=10 * (1 + sum(o.success for o in made)) if won else 200,
                note="the physics broke down: <script>alert(1)</script>" if letter == "b" else "",
                flow=error,
            )
        )
    return made


def training(policy: str, **changes: Any) -> TrainingRecord:
    values = {
        "policy": policy, "settings": SETTINGS, "steps": 1000, "cpu_s": 240.0, "weights": 5_000_000, "device": "cpu",
        "precision": "bf16", "demonstrations": 10, "held_out": {"action_l1": 0.02, "action_l1_zero": 0.4},
        "versions": {"flowlab": "0.1.0", "torch": "2.13.0"}, "processor": "Some CPU",
    }  # fmt: skip
    return TrainingRecord.model_validate(values | changes)


def result(
    label: str, *tried: list[EpisodeResult], name: str = "", evaluations: Sequence[Evaluation] = (), **changes: Any
):
    of = [o for part in tried for o in part]
    last = [Evaluation(step=1000, n_action_steps=8, outcomes=tuple(of))] if of else []
    tasks = tuple(dict.fromkeys(o.task for e in (*evaluations, *last) for o in e.outcomes))
    return PolicyResult(
        name=name or "-".join((*tasks, label)),
        label=label,
        tasks=tasks,
        training=training(label.partition("-")[0], **changes),
        evaluations=(*evaluations, *last),
    )


def wilson(k: int, n: int) -> tuple[float, float]:
    """By the textbook's formula, with the normal's 97.5 % quantile."""
    z = 1.959963984540054
    middle = (k + z * z / 2) / (n + z * z)
    half = z / (n + z * z) * math.sqrt(k * (n - k) / n + z * z / 4)
    return middle - half, middle + half


def mcnemar(b: int, c: int) -> float:
    """Exact and two-sided: the chance of splits no likelier than this one, counted in whole numbers."""
    n = b + c
    ways = [math.comb(n, k) for k in range(n + 1)]
    return float(Fraction(sum(w for w in ways if w <= ways[b]), 2**n))


EXAMPLE = [
    result("dp3", outcomes("push", "ssslffffbf"), cpu_s=120.0),
    result("fdp", outcomes("push", "sssssslfff", error=flow(4.0))),
    result("fdp", outcomes("assembly", "ssff", error=flow(10.0, pairs=300, ends=20))),
    result("dp3", outcomes("assembly", "sfff")),
    result("dp3", outcomes("hammer", "ss")),
]
"""dp3 4 of 10, 1 of 4, 2 of 2; fdp 7 of 10, 2 of 4, and no hammer."""


def test_success_is_counted_task_by_task() -> None:
    summary = summarize(EXAMPLE)
    assert summary.labels == ("dp3", "fdp")
    assert summary.tasks == ("hammer", "assembly", "push")  # by difficulty, then by name
    found = {(x.label, x.task): x for x in summary.successes}
    counts = {key: (x.success.successes, x.success.n, x.success_dp3.successes) for key, x in found.items()}
    assert counts == {
        ("dp3", "push"): (4, 10, 3), ("fdp", "push"): (7, 10, 6), ("fdp", "assembly"): (2, 4, 2),
        ("dp3", "assembly"): (1, 4, 1), ("dp3", "hammer"): (2, 2, 2),
    }  # fmt: skip
    for x in found.values():
        for share in (x.success, x.success_dp3):
            assert (share.low, share.high) == pytest.approx(wilson(share.successes, share.n), abs=1e-6)
    push = found["dp3", "push"]
    assert (push.group, push.mean_steps, push.broken) == ("hard", 25.0, 1)
    assert found["fdp", "push"].broken == 0
    assert summarize([result("dp3", outcomes("push", "ff"))]).successes[0].mean_steps is None


def test_groups_have_both_averages_and_name_their_tasks() -> None:
    found = {(g.label, g.group): g for g in summarize(EXAMPLE).groups}
    assert set(found) == {("dp3", "medium"), ("dp3", "hard"), ("fdp", "hard"), ("dp3", ALL), ("fdp", ALL)}
    hard = found["dp3", "hard"]
    assert (hard.tasks, hard.of) == (("assembly", "push"), 6)
    assert (hard.success.successes, hard.success.n) == (5, 14)
    assert (hard.success.low, hard.success.high) == pytest.approx(wilson(5, 14), abs=1e-6)
    assert hard.task_mean == pytest.approx((1 / 4 + 4 / 10) / 2)
    assert hard.task_mean_dp3 == pytest.approx((1 / 4 + 3 / 10) / 2)
    assert hard.mean_steps == pytest.approx((10 + 10 + 20 + 30 + 40) / 5)
    whole = found["dp3", ALL]
    assert (whole.tasks, whole.of, whole.success.n) == (("hammer", "assembly", "push"), 50, 16)
    assert whole.task_mean == pytest.approx((1 / 4 + 4 / 10 + 1) / 3, abs=1e-6)
    assert found["fdp", ALL].tasks == ("assembly", "push")


def test_policies_are_compared_on_the_episodes_that_both_tried() -> None:
    more = [*EXAMPLE, result("mba", outcomes("push", "fs", first=9))]  # episodes 9 and 10; the others have 0 to 9
    found = {(c.first, c.second, c.over): c for c in summarize(more).comparisons}
    assert {key[2] for key in found if key[:2] == ("dp3", "fdp")} == {ALL, "hard", "push", "assembly"}
    one = found["dp3", "fdp", "push"]
    assert (one.paired.both, one.paired.first_only, one.paired.second_only, one.paired.neither) == (4, 0, 3, 3)
    assert one.paired.p_value == pytest.approx(mcnemar(0, 3)) == 0.25
    both = found["dp3", "fdp", ALL]
    assert (both.tasks, both.paired.n, both.paired.second_only) == (2, 14, 4)
    assert both.paired.p_value == pytest.approx(mcnemar(0, 4))
    assert found["dp3", "mba", ALL].paired.n == 1
    apart = [result("dp3", outcomes("push", "s")), result("fdp", outcomes("push", "s", seed=1))]
    assert summarize(apart).comparisons == ()


@given(st.lists(st.tuples(st.booleans(), st.booleans()), min_size=1, max_size=40))
def test_pairs_are_mcnemars(pairs: list[tuple[bool, bool]]) -> None:
    first, second = ("".join("fs"[side] for side in sides) for sides in zip(*pairs, strict=True))
    results = [result("dp3", outcomes("push", first)), result("fdp", outcomes("push", second))]
    (whole, *_) = summarize(results).comparisons
    b, c = pairs.count((True, False)), pairs.count((False, True))
    assert (whole.paired.first_only, whole.paired.second_only, whole.paired.n) == (b, c, len(pairs))
    assert whole.paired.p_value == pytest.approx(mcnemar(b, c))


def test_flow_is_pooled_over_points() -> None:
    found = {(f.label, f.over): f for f in summarize(EXAMPLE).flow}
    assert set(found) == {("fdp", over) for over in (ALL, "hard", "push", "assembly")}
    whole = found["fdp", ALL]
    pairs, ends = 10 * 100 + 4 * 300, 10 * 10 + 4 * 20
    assert (whole.episodes, whole.error.pairs, whole.error.ends, whole.error.still_pairs) == (14, pairs, ends, 700)
    assert whole.error.ade_mm == pytest.approx((1000 * 4 + 1200 * 10) / pairs, abs=1e-6)
    assert whole.error.zero_ade_mm == pytest.approx(3 * whole.error.ade_mm, abs=1e-5)
    assert whole.error.fde_mm == pytest.approx((100 * 8 + 80 * 20) / ends, abs=1e-6)
    assert found["fdp", "push"].error.ade_mm == 4.0


errors = st.builds(
    flow, st.floats(0, 100), pairs=st.integers(1, 10_000), ends=st.integers(1, 1000), still=st.integers(0, 1000),
    apd=st.floats(0, 1), zero_apd=st.floats(0, 1), average_jaccard=st.floats(0, 1), still_mm=st.floats(0, 20),
)  # fmt: skip


@given(st.lists(errors, min_size=1, max_size=6), st.integers(0, 6))
def test_pooling_is_a_weighted_mean_however_episodes_are_grouped(parts: list[RolloutFlowError], cut: int) -> None:
    whole = pool_flow(parts)
    weights = {"fde_mm": "ends", "zero_fde_mm": "ends", "still_mm": "still_pairs"}
    for name in RolloutFlowError.model_fields.keys() - {"pairs", "ends", "still_pairs"}:
        heavy = np.array([getattr(e, weights.get(name, "pairs")) for e in parts])
        expected = np.average([getattr(e, name) for e in parts], weights=heavy) if heavy.sum() else 0.0
        assert getattr(whole, name) == pytest.approx(expected, abs=1e-6)
    again = pool_flow([pool_flow(part) for part in (parts[:cut], parts[cut:]) if part])
    assert again.model_dump() == pytest.approx(whole.model_dump(), abs=2e-6)


def evaluation(step: int, solved: str, n_action_steps: int = 8, task: str = "push") -> Evaluation:
    return Evaluation(step=step, n_action_steps=n_action_steps, outcomes=tuple(outcomes(task, solved)))


def test_a_curve_has_the_same_episodes_at_every_checkpoint() -> None:
    """Earlier checkpoints are tried on fewer episodes than the last."""
    earlier = [evaluation(250, "sfff"), evaluation(500, "ssff")]
    r = result("fdp", outcomes("push", "sssfffffff"), evaluations=earlier)
    points = summarize([r]).curves
    assert [(p.label, p.task, p.step, p.cpu_min) for p in points] == [
        ("fdp", "push", 250, 1.0), ("fdp", "push", 500, 2.0), ("fdp", "push", 1000, 4.0),
    ]  # fmt: skip
    assert [(p.success.successes, p.success.n) for p in points] == [(1, 4), (2, 4), (3, 4)]
    assert (points[2].success.low, points[2].success.high) == pytest.approx(wilson(3, 4), abs=1e-6)
    assert summarize([r]).successes[0].success.n == 10  # what counts is of all
    assert summarize(EXAMPLE).curves == ()
    one = summarize([result("fdp", outcomes("push", "s"), evaluations=[evaluation(500, "f", n_action_steps=1)])])
    assert one.curves == ()  # of another way to execute plans


def test_one_step_of_a_plan_against_eight() -> None:
    at_once = evaluation(1000, "fsss", n_action_steps=1)
    old = evaluation(500, "ffff", n_action_steps=1)
    r = result("fdp", outcomes("push", "ssffff"), evaluations=[old, at_once])
    whole, hard, push = summarize([r]).strides
    assert (whole.over, hard.over, push.over) == (ALL, "hard", "push")
    assert (push.usual, push.other) == (8, 1)
    assert (push.usual_success.successes, push.usual_success.n) == (2, 4)
    assert (push.other_success.successes, push.other_success.n) == (3, 4)
    assert (push.paired.first_only, push.paired.second_only) == (1, 2)
    assert summarize([r]).successes[0].success.n == 6
    assert summarize([result("fdp", outcomes("push", "ss"), evaluations=[old])]).strides == ()  # of other weights
    assert summarize(EXAMPLE).strides == ()


def test_what_broke_down_is_listed() -> None:
    (broken,) = summarize(EXAMPLE).broken
    assert (broken.label, broken.trial, broken.step) == ("dp3", Trial("push", 0, 8), 1000)
    assert broken.note.startswith("the physics")


def test_labels_come_in_the_order_of_the_paper() -> None:
    labels = ["mine", "fdp-m200", "fdp", "mba", "fdp-m50", "dp3", "fdp-auxiliary", "2nd"]
    summary = summarize([result(label, outcomes("push", "s")) for label in labels])
    assert summary.labels == ("dp3", "mba", "fdp", "fdp-auxiliary", "fdp-m50", "fdp-m200", "2nd", "mine")


def test_results_of_one_label_on_one_task_are_told_apart() -> None:
    """Else their episodes would be mixed."""
    twice = [
        result("fdp", outcomes("push", "ss"), name="short"),
        result("fdp", outcomes("push", "sf"), outcomes("hammer", "s"), name="long"),
        result("fdp", outcomes("assembly", "s")),
    ]
    assert summarize(twice).labels == ("fdp", "long", "short")
    with pytest.raises(DataError, match="2 results on push are all called same; rename"):
        summarize([result("fdp", outcomes("push", "s"), name="same") for _ in range(2)])


# the paper


def test_the_papers_numbers() -> None:
    """Copied from its tables once more, and its own averages of its own numbers."""
    rows = {row.label: list(row.percent.values()) for row in MAIN.rows if row.percent}
    assert rows == {"dp3": [85.8, 51.1, 52.4, 46.5], "mba": [84.2, 49.7, 53.0, 46.9], "fdp": [86.5, 55.3, 55.6, 47.9]}
    assert MAIN.columns == ("easy", "medium", "hard", "very-hard")
    for row in QUERY_POINTS.rows:
        *tasks, mean = row.percent.values()
        assert np.mean(tasks) == pytest.approx(mean, abs=0.051)
    assert [row.percent["hand-insert"] for row in QUERY_POINTS.rows] == [3.3, 5.0, 8.3]
    scene, plain = (next(r for r in QUERY_PLACES.rows if r.label == x) for x in ("fdp", "fdp-object"))
    assert list(scene.percent.values()) == [98.3, 53.3, 68.3, 93.3, 41.7]
    assert list(plain.percent.values()) == [93.3, 51.7, 48.3, 86.7, 38.3]
    assert paper_share("fdp", "hard") == 0.556  # of 600 episodes, not 60
    assert paper_share("fdp-m50", "push") == 0.567
    assert paper_share("dp3", "push") is None


def test_the_papers_number_stands_beside_ours() -> None:
    results = [*EXAMPLE, result("fdp-auxiliary", outcomes("push", "sf"))]
    main, points = compare_with_paper(summarize(results))  # of the third we have nothing
    cells = {(r.label, c): cell for r in main.rows for c, cell in zip(main.columns, r.cells, strict=True)}
    hard = cells["dp3", "hard"]
    assert (hard.paper, hard.ours, hard.n, hard.tasks, hard.of) == (0.524, pytest.approx(0.325), 14, 2, 6)
    assert (hard.low, hard.high) == pytest.approx(wilson(5, 14), abs=1e-6)
    assert (cells["mba", "hard"].paper, cells["mba", "hard"].ours) == (0.53, None)
    assert (cells["fdp", "easy"].paper, cells["fdp", "easy"].ours) == (0.865, None)
    assert (cells["fdp-auxiliary", "hard"].paper, cells["fdp-auxiliary", "hard"].ours) == (None, 0.5)
    assert [r.label for r in points.rows] == ["fdp-m50", "fdp", "fdp-m200"]
    push = points.rows[1].cells[points.columns.index("push")]
    assert (push.paper, push.ours, push.n) == (0.617, 0.7, 10)
    assert (points.rows[0].cells[0].paper, points.rows[0].cells[0].ours) == (0.833, None)


def test_tables_in_which_we_have_nothing_are_left_out() -> None:
    assert [t.source for t in compare_with_paper(summarize([result("fdp", outcomes("reach", "s"))]))] == [MAIN.source]
    assert compare_with_paper(summarize([result("mine", outcomes("push", "s"))])) == []


def test_what_differs_is_told_from_how_policies_were_trained() -> None:
    told = " ".join(differences(summarize(EXAMPLE)))
    assert "for 2.0 to 4.0 CPU minutes, 1,000 steps, on Some CPU (cpu, bf16)" in told
    assert "of 2 to 10 episodes of each task, of the evaluation seeds 0:" in told
    assert "Both learned from 10 demonstrations" in told
    assert "one for all query points" in told
    assert "turns scenes" in told
    assert "MBA" not in told
    plain = {
        "n_action_steps": 1,
        "motion": {"flow_representation": "channels"},
        "action": {"kind": "unet"},
        "batch": {"shift_m": 0.0},
    }
    other = result("fdp", outcomes("push", "s"), settings=plain, demonstrations=25, steps=7)
    told = " ".join(differences(summarize([other, result("mba", outcomes("push", "s"), settings=plain)])))
    assert "from 10 to 25 demonstrations" in told
    assert "7 to 1,000 steps" in told
    assert "execute 1 steps" in told
    assert "Our MBA is" in told
    for absent in ("one for all query points", "turns scenes", "residual layers", "pure noise"):
        assert absent not in told


# files


def read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_line_for_every_label_and_task(tmp_path: Path) -> None:
    write_report(tmp_path, EXAMPLE)
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
    write_report(tmp_path, results)
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
    write_report(tmp_path / "one", results)
    write_report(tmp_path / "two", mixed)
    one, two = contents(tmp_path / "one"), contents(tmp_path / "two")
    assert one.keys() == {
        "report.json", "report.csv", "episodes.csv", "report.html", "figures/success.png", "figures/flow.png",
    }  # fmt: skip
    assert one == two


def test_the_json_holds_the_summary(tmp_path: Path) -> None:
    write_report(tmp_path, EXAMPLE)
    values = json.loads((tmp_path / "report.json").read_text())
    assert values["summary"] == json.loads(summarize(EXAMPLE).model_dump_json())
    assert values["flowlab"]
    assert [table["source"] for table in values["paper"]] == [MAIN.source, QUERY_POINTS.source]


def test_a_new_report_replaces_all_of_an_old_one(tmp_path: Path) -> None:
    write_report(tmp_path, [result("fdp", outcomes("push", "sss", error=flow(1)), evaluations=[evaluation(500, "sf")])])
    assert {p.name for p in (tmp_path / "figures").iterdir()} == {"success.png", "curves.png", "flow.png"}
    write_report(tmp_path, [result("dp3", outcomes("push", "sss"))])
    assert {p.name for p in (tmp_path / "figures").iterdir()} == {"success.png"}
    assert len(read_csv(tmp_path / "episodes.csv")) == 3


def test_nothing_is_no_report(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nothing to report; evaluate a policy first, with: flowlab eval RUN"):
        write_report(tmp_path / "r", [])
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


# the page


class Page(HTMLParser):
    """What a browser would see: tables as rows of (text, columns spanned, bold), addresses, and tags left open."""

    VOID = ("meta", "img", "br")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tables: list[list[list[tuple[str, int, bool]]]] = []
        self.addresses: list[str] = []
        self.ids: list[str] = []
        self.text = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.addresses += [v for k, v in values.items() if k in ("href", "src", "srcset", "action", "data") and v]
        self.ids += [values["id"] or ""] if "id" in values else []
        if tag in self.VOID:
            return
        assert tag in ("html", "head", "title", "style", "body") or self.open[:2] == ["html", "body"], tag
        if tag == "table":
            assert "table" not in self.open
            self.tables.append([])
        if tag == "tr":
            assert self.open[-1] in ("thead", "tbody")
            self.tables[-1].append([])
        if tag in ("td", "th"):
            assert self.open[-1] == "tr"
            self.tables[-1][-1].append(("", int(values.get("colspan") or 1), False))
        if tag == "b":
            text, span, _ = self.tables[-1][-1][-1]
            self.tables[-1][-1][-1] = (text, span, True)
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" in self.open:
            assert "url(" not in data
            assert "@import" not in data
            return
        self.text += data
        if {"td", "th"} & set(self.open):
            text, span, bold = self.tables[-1][-1][-1]
            self.tables[-1][-1][-1] = (f"{text} {data}".strip(), span, bold)

    def rows(self, *header: str) -> list[list[str]]:
        """The cells of the first table whose header begins like this."""
        table = next(t for t in self.tables if [c[0] for c in t[0]][: len(header)] == list(header))
        return [[" ".join(cell[0].split()) for cell in row] for row in table[1:]]


def full() -> list[PolicyResult]:
    """Results that fill every section."""
    curve = [evaluation(500, "sfsf"), evaluation(1000, "ssff", n_action_steps=1)]
    return [
        *EXAMPLE[1:],
        result("dp3", outcomes("push", "ssslffffbf"), evaluations=curve),
        result("fdp-m50", outcomes("push", "sb")),
    ]


def read_page(folder: Path, *results: PolicyResult, **more: Any) -> Page:
    write_report(folder, results, **more)
    return Page((folder / "report.html").read_text())


def test_the_page_is_whole_and_needs_nothing_else(tmp_path: Path) -> None:
    page = read_page(tmp_path, *full())
    assert len(page.tables) == 12
    for table in page.tables:
        assert len(table) > 1
        assert len({sum(span for _, span, _ in row) for row in table}) == 1
    figures = [base64.b64decode(a.removeprefix("data:image/png;base64,")) for a in page.addresses if a[0] == "d"]
    assert figures == [(tmp_path / f"figures/{name}.png").read_bytes() for name in ("success", "curves", "flow")]
    assert [a for a in page.addresses if a[0] != "d"] == ["#pairs"]
    assert page.ids == ["pairs"]
    assert "http" not in page.text
    assert "<script>alert(1)</script>" in page.text  # what an episode's note says is text, not markup


def test_the_page_shows_policies_side_by_side(tmp_path: Path) -> None:
    page = read_page(tmp_path, *full())
    rows = page.rows("task", "dp3", "fdp", "fdp-m50")
    assert [row[0] for row in rows] == ["hammer", "assembly", "push", "hard", ALL]
    assert rows[2] == ["push", "40.0 17–69 n 10", "70.0 40–89 n 10", "50.0 9–91 n 2"]
    assert rows[3][1:3] == ["32.5 16–61 2 of 6 tasks", "60.0 39–84 2 of 6 tasks"]
    assert rows[0][2:] == ["–", "–"]
    assert [bold for *_, bold in page.tables[0][3]] == [False, False, True, False]
    assert page.rows("policies")[0] == ["dp3 against fdp", "14", "0", "4", "5", "5", "0.12"]
    assert ["all", "fdp", "14", "7.3 21.8", "13.3 33.3", "60.0 30.0", "50.0 20.0", "1.0"] in page.rows("on", "policy")
    main = page.rows("", "easy")
    assert main[1][:7] == ["DP3 dp3", "85.8", "-", "51.1", "100.0 34–100 n 2 1 of 11 tasks", "52.4", main[1][6]]


def test_the_best_is_bold_where_policies_can_be_compared() -> None:
    def bold(*results: PolicyResult) -> dict[str, list[bool | None]]:
        return {r.name: [c and c.best for c in r.cells] for r in success_rows(summarize(results))}

    assert bold(*EXAMPLE) == {
        "hammer": [False, None],  # there is no other
        "assembly": [False, True],
        "push": [False, True],
        "hard": [False, True],
        ALL: [False, False],  # of other tasks
    }
    part = result("fdp-m50", outcomes("push", "sssff"))  # of one task as good as fdp of two
    assert bold(*EXAMPLE, part)["hard"] == [False, True, False]
    even = [result(label, outcomes("push", "sf")) for label in ("dp3", "mba")]
    assert bold(*even) == {"push": [False, False]}
    assert bold(*even, result("fdp", outcomes("push", "ff"))) == {"push": [True, True, False]}


def test_episodes_are_counted_once_where_they_are_as_many_everywhere(tmp_path: Path) -> None:
    page = read_page(tmp_path, *(result(label, outcomes("push", "sf")) for label in ("dp3", "fdp")))
    assert page.rows("task", "dp3") == [["push", "50.0 9–91", "50.0 9–91"]]
    assert "Episodes solved [%], of 2 of each task and policy, and" in page.text


def test_films_are_linked_by_relative_addresses(tmp_path: Path) -> None:
    films = [tmp_path / "out/films/push 3%.mp4", tmp_path / "runs/x.rrd"]
    page = read_page(tmp_path / "out", result("fdp", outcomes("push", "s")), films=films)
    assert page.addresses[-2:] == ["films/push%203%25.mp4", "../runs/x.rrd"]
    assert "push 3%.mp4" in page.text


def scored(solved: Iterable[bool]) -> list[RobotTrial]:
    return [RobotTrial("fdp", "pour", str(k), won) for k, won in enumerate(solved)]


def test_trials_that_somebody_scored_have_a_section_of_their_own(tmp_path: Path) -> None:
    page = read_page(tmp_path / "both", result("fdp", outcomes("push", "s")), scored=scored([True, True, False]))
    low, high = wilson(2, 3)
    assert page.rows("task", "policy", "solved", "of", "%", "95 % interval") == [
        ["pour", "fdp", "2", "3", "66.7", f"{100 * low:.0f} - {100 * high:.0f}"]
    ]
    alone = read_page(tmp_path / "alone", scored=scored([True]))
    assert len(alone.tables) == 1
    values = json.loads((tmp_path / "alone/report.json").read_text())
    assert values["scored"][0]["rows"][0][:4] == ["pour", "fdp", 1, 1]
    assert not list((tmp_path / "alone").glob("figures/*"))
