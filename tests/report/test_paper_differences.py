"""What differs from the paper is told from how policies were trained."""

from policy_results import EXAMPLE, flow, outcomes, result

from flowlab.benchmark.summary import summarize
from flowlab.report.paper_differences import paper_differences


def test_what_differs_is_told_from_how_policies_were_trained() -> None:
    told = " ".join(paper_differences(summarize(EXAMPLE)))
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
    other = result("fdp", outcomes("push", "s", error=flow(1.0)), settings=plain, demonstrations=25, steps=7)
    told = " ".join(paper_differences(summarize([other, result("mba", outcomes("push", "s"), settings=plain)])))
    assert "from 10 to 25 demonstrations" in told
    assert "7 to 1,000 steps" in told
    assert "execute 1 steps" in told
    assert "Our MBA is" in told
    for absent in ("one for all query points", "turns scenes", "residual layers", "pure noise"):
        assert absent not in told
