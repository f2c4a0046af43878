"""Example 4 adds a stage, whose module lies beside the recipe."""

from pathlib import Path

from conftest import Cli

RECIPE = Path(__file__).parents[2] / "examples" / "04_own_stage" / "recipe.yaml"


def extract(flowlab: Cli, folder: Path, *options: str) -> str:
    fixed = ["extract-sim", "drawer-open", "--episodes", 1, "--workers", 1, "--out", folder / "data"]
    done = flowlab(*fixed, "--recipe", RECIPE, *options, cwd=folder)
    return str(done.stdout + done.stderr)


def test_the_stage_keeps_what_is_in_view(flowlab: Cli, tmp_path: Path) -> None:
    output = extract(flowlab, tmp_path)
    assert "in_view:InView" in output
    assert "1 episode," in output
    assert (tmp_path / "data" / "stats.json").exists()


def test_its_setting_decides_what_is_in_view(flowlab: Cli, tmp_path: Path) -> None:
    output = extract(flowlab, tmp_path, "--set", "in_view:InView.min_share=1.0", "--dry-run")
    assert "in view" in output
