"""The figures of the house: how long files and functions are, what circles, what is named twice, what is undocumented.

``make house`` prints them; ``test_house.py`` holds them. Only sources are read; nothing is imported.
"""

import ast
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

ROOT = Path(__file__).parents[2]
PROSE = ("flowlab", "tests", "benchmarks", "examples", "pipelines", "docs")
"""Folders whose code, comments and prose are in American spelling; results, which are data, are not read."""

BRITISH = re.compile(
    r"(?<![A-Za-z])("
    r"(?:dis)?colour\w*|grey\w*|centr(?:e|es|ed|ing)|neighbour\w*|behaviour\w*|favour\w*|honour\w*"
    r"|labour\w*|endeavour\w*|flavour\w*|rumour\w*|vapour\w*|armour\w*|harbour\w*"
    r"|label(?:led|ling|ler)|model(?:led|ling|ler)|cancel(?:led|ling)|travel(?:led|ling)|signal(?:led|ling)"
    r"|channel(?:led|ling)|fuel(?:led|ling)|level(?:led|ling)|tunnel(?:led|ling)|marvellous|jewellery"
    r"|(?:milli|centi|kilo|micro)?metres?|litres?|fibres?|theatres?|licen(?:ce|ces)|defence|offence|pretence"
    r"|catalogue\w*|dialogue|analogue|artefact\w*|programme|programmes|aluminium|tyres?|kerb|mould\w*|plough\w*"
    r"|sceptic\w*|ageing|judgement\w*|acknowledgement\w*|fulfil|fulfils|skilful|learnt|spelt|spilt|burnt|dreamt|leant"
    r"|whilst|amongst|towards|afterwards|backwards|practis(?:e|ed|ing|es)|analys(?:e|ed|es|ing)|paralys\w*|catalys\w*"
    r"|(?:general|normal|optim|minim|maxim|real|recogn|organ|summar|visual|serial|discret|quant|vector|parallel|random"
    r"|standard|util|special|synchron|emphas|initial|regular|final|local|global|central|categor|author|custom|capital"
    r"|character|critic|equal|familiar|harmon|ideal|item|material|memor|modern|neutral|penal|polar|priorit|sanit|stabil"
    r"|symbol|token|color|raster|voxel|linear|digit|factor|symmetr|hypothes|synthes)is(?:e|ed|es|er|ers|ing|ation|ations)"
    r")(?![A-Za-z])",
    re.IGNORECASE,
)
"""Words that American English spells differently. ``afterward``, ``toward`` and the like are what it has."""
_ALLOWED = {"towards", "afterwards", "backwards", "judgement", "judgements"}
"""Words that American dictionaries list as well."""


@dataclass(frozen=True, slots=True)
class Function:
    """One ``def`` and where it stands."""

    where: str
    """``file:line``."""
    name: str
    """With its class, as in ``Dataset.episode``."""
    node: ast.FunctionDef | ast.AsyncFunctionDef
    nested: bool
    """Whether it lies in another function."""

    @property
    def lines(self) -> int:
        """From ``def`` to its last line, signature and docstring included."""
        return (self.node.end_lineno or self.node.lineno) - self.node.lineno + 1

    @property
    def is_private(self) -> bool:
        """Whether it, or the class it belongs to, begins with an underscore."""
        return any(part.startswith("_") for part in self.name.split("."))

    @property
    def is_magic(self) -> bool:
        """Whether Python itself gives the name its meaning."""
        return self.node.name.startswith("__") and self.node.name.endswith("__")


@dataclass(frozen=True)
class Source:
    """One file of the library, parsed."""

    path: Path
    root: Path = ROOT

    @cached_property
    def text(self) -> str:
        """What it holds."""
        return self.path.read_text()

    @cached_property
    def tree(self) -> ast.Module:
        """Its syntax tree."""
        return ast.parse(self.text)

    @property
    def lines(self) -> int:
        """How many lines it has."""
        return len(self.text.splitlines())

    @property
    def module(self) -> str:
        """Its dotted name."""
        parts = self.path.relative_to(self.root).with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)

    def where(self, line: int = 1) -> str:
        """``file:line``, as editors open it."""
        return f"{self.path.relative_to(self.root)}:{line}"

    def functions(self) -> Iterator[Function]:
        """Every ``def``, nested ones too."""
        yield from self._functions(self.tree, "", nested=False)

    def _functions(self, node: ast.AST, prefix: str, *, nested: bool) -> Iterator[Function]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
                yield Function(self.where(child.lineno), prefix + child.name, child, nested)
                yield from self._functions(child, f"{prefix}{child.name}.", nested=True)
            elif isinstance(child, ast.ClassDef):
                yield from self._functions(child, f"{prefix}{child.name}.", nested=nested)
            else:
                yield from self._functions(child, prefix, nested=nested)

    def classes(self) -> Iterator[ast.ClassDef]:
        """Every class at module level."""
        return (node for node in self.tree.body if isinstance(node, ast.ClassDef))


@dataclass(frozen=True)
class House:
    """All sources of the library."""

    root: Path = ROOT

    @cached_property
    def sources(self) -> tuple[Source, ...]:
        """By path."""
        return tuple(Source(path, self.root) for path in sorted((self.root / "flowlab").rglob("*.py")))

    @cached_property
    def functions(self) -> tuple[Function, ...]:
        """Of all files."""
        return tuple(f for source in self.sources for f in source.functions())

    def undocumented(self) -> list[str]:
        """Modules, classes and public functions without a docstring; nested and magic functions need none."""
        functions = [f for f in self.functions if not f.nested and not f.is_magic and not _overloaded(f.node)]
        functions = [f for f in functions if not f.is_private and not ast.get_docstring(f.node)]
        named = [f"{f.where} {f.name}" for f in functions]
        return self._bare_modules_and_classes() + named

    def _bare_modules_and_classes(self) -> list[str]:
        bare = [s.where() for s in self.sources if not ast.get_docstring(s.tree)]
        for source in self.sources:
            bare += [
                f"{source.where(c.lineno)} class {c.name}"
                for c in source.classes()
                if not c.name.startswith("_") and not ast.get_docstring(c)
            ]
        return bare

    def unannotated(self) -> list[str]:
        """Functions that do not say what they return."""
        return [f"{f.where} {f.name}" for f in self.functions if f.node.returns is None]

    def twice(self) -> list[str]:
        """Public class names that stand for more than one class."""
        places = defaultdict(list)
        for source in self.sources:
            for node in source.classes():
                if not node.name.startswith("_"):
                    places[node.name].append(source.where(node.lineno))
        return [f"{name}: {', '.join(where)}" for name, where in sorted(places.items()) if len(where) > 1]

    def circles(self) -> list[str]:
        """Modules that need each other while they are imported."""
        modules = {s.module for s in self.sources}
        needs = {s.module: imported(s, modules) for s in self.sources}
        return [" -> ".join([*circle, circle[0]]) for circle in _circles(needs)]

    def exported(self) -> dict[str, tuple[Source, ast.AST]]:
        """What ``import flowlab`` offers, by name, and where it is defined; ``data`` is a room, and offers its own."""
        offered = [*_lazy_table(self._source("flowlab")), *self._of_data()]
        return {name: self._definition(module, name) for name, module in offered if module != "flowlab"}

    def _of_data(self) -> list[tuple[str, str]]:
        there = any(s.module == "flowlab.data.windows" for s in self.sources)
        return [("Windows", "flowlab.data.windows")] if there else []

    def _source(self, module: str) -> Source:
        found = next((s for s in self.sources if s.module == module), None)
        if found is None:
            raise LookupError(f"flowlab exports something of {module}, which does not exist")
        return found

    def _definition(self, module: str, name: str) -> tuple[Source, ast.AST]:
        source = self._source(module)
        for node in source.tree.body:
            if getattr(node, "name", None) == name:
                return source, node
            if isinstance(node, ast.ImportFrom) and name in {a.asname or a.name for a in node.names}:
                return self._definition(node.module or "", name)
        return source, source.tree

    def untold(self) -> list[str]:
        """Exported functions and methods that take, give or raise something, and do not say so in a section."""
        return [
            f"{source.where(node.lineno)} {name} has no {section}"
            for exported, (source, definition) in self.exported().items()
            for name, node in _callables(exported, definition)
            for section in _sections(node)
            if f"{section}\n" not in (ast.get_docstring(node) or "") + "\n"
        ]


def imported(source: Source, modules: set[str]) -> set[str]:
    """Modules of the library that are imported as soon as this one is; what is only for type checkers is not."""
    found = set()
    for node in _executed(source.tree.body):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names if a.name in modules}
        elif isinstance(node, ast.ImportFrom) and node.module:
            inner = {f"{node.module}.{a.name}" for a in node.names}
            found |= inner & modules if inner & modules else {node.module} & modules
    return found


def _executed(body: Iterable[ast.stmt]) -> Iterator[ast.stmt]:
    """Statements that run while a module is imported."""
    for node in body:
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            yield from _executed(node.orelse)
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node
            for block in ("body", "orelse", "finalbody"):
                yield from _executed(getattr(node, block, []))


def _circles(needs: dict[str, set[str]]) -> list[list[str]]:
    """One circle from each knot of modules, found by walking in depth."""
    done: set[str] = set()
    found: list[list[str]] = []

    def walk(module: str, path: list[str]) -> None:
        if module in path:
            found.append(path[path.index(module) :])
        elif module not in done:
            for needed in sorted(needs[module]):
                walk(needed, [*path, module])
            done.add(module)

    for module in sorted(needs):
        walk(module, [])
    return found


def british(root: Path = ROOT, folders: tuple[str, ...] = PROSE) -> list[str]:
    """British words in code and prose. A quoted word alone is a name: of an old setting, say, that is still read."""
    files = [p for folder in folders for kind in ("py", "md", "yaml", "j2") for p in (root / folder).rglob(f"*.{kind}")]
    files = [p for p in files if not {"results", "fixtures"} & set(p.parts) and Path(__file__).parent not in p.parents]
    found = []
    for path in [*sorted(files), root / "README.md", root / "CONTRIBUTING.md", root / "CHANGELOG.md"]:
        text = path.read_text() if path.exists() else ""
        if path.name == "CHANGELOG.md":  # what was released is history, and not written anew
            text = text.split("\n## [", 2)[0] if "Unreleased" not in text else _unreleased(text)
        for number, line in enumerate(text.splitlines(), 1):
            words = [m for m in BRITISH.finditer(line) if m[1].lower() not in _ALLOWED and not _is_name(line, m)]
            found += [f"{path.relative_to(root)}:{number} {m[1]}" for m in words]
    return found


def _unreleased(text: str) -> str:
    """The changelog down to its first release."""
    head, _, rest = text.partition("Unreleased")
    return head + re.split(r"\n## ", rest, maxsplit=1)[0]


def _is_name(line: str, word: re.Match[str]) -> bool:
    """Whether a word is quoted: the name of an old setting, or a word that is misspelled on purpose."""
    before, after = line[: word.start()], line[word.end() :]
    return before[-1:] in set("\"'`.") and after[:1] in set("\"'`.=:")


def _callables(name: str, node: ast.AST) -> Iterator[tuple[str, ast.FunctionDef]]:
    """A function, or the public methods of a class."""
    if isinstance(node, ast.FunctionDef):
        yield name, node
    elif isinstance(node, ast.ClassDef):
        for child in node.body:
            if isinstance(child, ast.FunctionDef) and not child.name.startswith("_") and not _is_property(child):
                yield f"{name}.{child.name}", child


def _is_property(node: ast.FunctionDef) -> bool:
    return any("property" in ast.dump(d) or "validator" in ast.dump(d) for d in node.decorator_list)


def _sections(node: ast.FunctionDef) -> Iterator[str]:
    """The sections that a docstring in Google's style must have."""
    arguments = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
    if node.args.vararg or node.args.kwarg or set(arguments) - {"self", "cls"}:
        yield "Args:"
    if node.returns is not None and ast.unparse(node.returns) not in ("None", "NoReturn"):
        yield "Yields:" if any(isinstance(n, ast.Yield | ast.YieldFrom) for n in ast.walk(node)) else "Returns:"
    if any(isinstance(n, ast.Raise) and n.exc is not None for n in ast.walk(node)):
        yield "Raises:"


def _overloaded(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    return any("overload" in ast.dump(d) for d in node.decorator_list)


def _lazy_table(init: Source) -> Iterator[tuple[str, str]]:
    """Name and module of each entry of ``_LAZY``, which may have ``**dict.fromkeys(names, module)`` among them."""
    tables = (n.value for n in init.tree.body if isinstance(n, ast.Assign) and ast.unparse(n.targets[0]) == "_LAZY")
    table = next(tables)
    assert isinstance(table, ast.Dict)
    for key, value in zip(table.keys, table.values, strict=True):
        if key is not None:
            yield ast.literal_eval(key), ast.literal_eval(value)
        else:
            assert isinstance(value, ast.Call)
            names, module = map(ast.literal_eval, value.args)
            yield from ((name, module) for name in names)


def percentile(numbers: Iterable[int], share: float) -> int:
    """The smallest of the numbers that at least so large a share does not exceed."""
    ordered = sorted(numbers)
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)]


def main() -> None:
    """Print every figure, and what is beyond its limit."""
    house = House()
    files, functions = [s.lines for s in house.sources], [f.lines for f in house.functions]
    print(f"{len(files)} files, {sum(files)} lines; {len(functions)} functions")
    for name, numbers in (("lines of a file", files), ("lines of a function", functions)):
        median, p90 = percentile(numbers, 0.5), percentile(numbers, 0.9)
        print(f"{name}: median {median}, p90 {p90}, longest {max(numbers)}")
    for name, found in (
        ("files above 350 lines", [s.where() for s in house.sources if s.lines > 350]),
        ("import circles", house.circles()),
        ("class names twice", house.twice()),
        ("public, without a docstring", house.undocumented()),
        ("without a return annotation", house.unannotated()),
        ("exported, without a section", house.untold()),
        ("British words", british()),
    ):
        print(f"{name}: {len(found)}", *found[:20], sep="\n  ")


if __name__ == "__main__":
    main()
