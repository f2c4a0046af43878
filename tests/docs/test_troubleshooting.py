"""Every sentence that the page of troubles quotes is one that the code says."""

import ast
import re
from functools import cache

import pytest
from test_docs import ROOT

GAP = "\0"


@cache
def sentences() -> str:
    """All texts in the code, a line each, with a gap for what is filled in."""
    trees = [ast.parse(path.read_text()) for path in sorted((ROOT / "flowlab").rglob("*.py"))]
    return "\n".join(_text(node).replace("\n", " ") for tree in trees for node in ast.walk(tree))


def _text(node: ast.AST) -> str:
    if isinstance(node, ast.JoinedStr):
        return "".join(_text(part) or GAP for part in node.values)
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return re.sub(r"(?<!{){\w+}", GAP, node.value)
    return ""


QUOTED = re.findall(r"^### `(.+)`$", (ROOT / "docs" / "troubleshooting.md").read_text(), re.MULTILINE)


def is_said(sentence: str) -> bool:
    return re.search(".*?".join(map(re.escape, sentence.split("…"))), sentences()) is not None


@pytest.mark.parametrize("sentence", QUOTED)
def test_the_sentence_is_one_that_the_code_says(sentence: str) -> None:
    assert is_said(sentence)


def test_there_are_sentences_and_others_are_noticed() -> None:
    assert len(QUOTED) > 12
    assert not is_said("the unit of depth is well known")
