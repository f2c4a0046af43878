"""What is counted for people agrees with its number: one episode is no '1 episodes'."""

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
COUNTED = {"episodes", "recordings", "demonstrations", "policies"}
ALWAYS_MANY = {
    "MAIN.episodes", "QUERY_POINTS.episodes", "DEMONSTRATIONS", "_span(counts, 'g')", "_span(counts, 'd')",
    "len(of_tasks)",  # all there are
    "np.size(ends)",  # told where there are several
    "len(data)", "len(self.episodes)",  # of what Python shows of itself
    "stats['episodes']",  # as the first flowlab wrote it
    "episodes",  # which is beyond what there can be
}  # fmt: skip


def bare_counts(source: str) -> Iterator[str]:
    """Numbers in f-strings that have one of the nouns after them, as they are written."""
    for node in ast.walk(ast.parse(source)):
        for number, words in zip(node.values, node.values[1:], strict=False) if isinstance(node, ast.JoinedStr) else ():
            if isinstance(number, ast.FormattedValue) and isinstance(words, ast.Constant):
                noun = words.value.split(" ")[1:2] if words.value.startswith(" ") else []
                if noun and noun[0].strip(".,:;()'\"") in COUNTED:
                    yield ast.unparse(number.value)


def test_things_are_counted_by_the_function_that_knows_of_one() -> None:
    found = {
        f"{path.relative_to(ROOT)}: {count}"
        for path in sorted((ROOT / "flowlab").rglob("*.py"))
        for count in bare_counts(path.read_text())
        if count not in ALWAYS_MANY
    }
    assert found == set()
