"""How the package hangs together, in numbers: imports, rooms, lines, names."""

from __future__ import annotations

import ast
import functools
import io
import tokenize
from collections import Counter
from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import motionstereo_cli

PACKAGE = Path(motionstereo_cli.__file__).parent

Graph = Mapping[str, set[str]]

#: Lowest first; a room imports none that stands after it. Rooms of one line do not either.
FLOORS = (
    ("errors",),
    ("params", "types"),
    ("compiled",),
    ("files", "method"),
    ("sources",),
    ("rig",),
    ("robot",),
    ("pipeline",),
    ("sinks",),
    ("check", "evaluation", "report"),
    ("runs",),
    ("batch", "simulate"),
    ("commands",),
    ("__main__",),
)

#: Tokens that are no code.
_NO_CODE = {
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT),
    *(tokenize.ENCODING, tokenize.ENDMARKER),
}


@functools.cache
def measured() -> dict[str, float]:
    """Return all figures by their names."""
    paths = {
        ".".join(("motionstereo_cli", *path.relative_to(PACKAGE).with_suffix("").parts)): path
        for path in sorted(PACKAGE.rglob("*.py"))
        if path.name != "__init__.py"
    }
    trees = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in paths.items()}
    anywhere = {name: set(_imports(ast.walk(tree))) & paths.keys() for name, tree in trees.items()}
    at_top = {name: set(_imports(_top(tree))) & paths.keys() for name, tree in trees.items()}
    rooms = {_room(name) for name in trees}
    arrows = {(_room(a), _room(b)) for a, known in anywhere.items() for b in known}
    scripts = [path for path in PACKAGE.rglob("*.js") if ".min." not in path.name]
    lines = sum(_code_lines(path) for path in PACKAGE.rglob("*.py"))
    return {
        "circles": _circles(anywhere),
        "arrows up": sum(_floor(b) >= _floor(a) for a, b in arrows if a != b),
        "arrows": sum(a != b for a, b in arrows),
        "modules at the root": len(list(PACKAGE.glob("*.py"))) - 1,  # but __init__
        "rooms": len(rooms),
        "lines of code": lines + sum(_script_lines(path) for path in scripts),
        "class names twice": _twice(trees),
        "imports in functions that a circle forces": sum(
            name in _reached(other, at_top)
            for name, known in anywhere.items()
            for other in known - at_top[name]
        ),
    }


def _room(name: str) -> str:
    return name.split(".")[1]


def _floor(room: str) -> int:
    floors = {each: level for level, rooms in enumerate(FLOORS) for each in rooms}
    return floors.get(room, len(FLOORS))


def _top(tree: ast.Module) -> Iterator[ast.AST]:
    """Yield the statements that run when a file is imported, or that type checkers see."""
    for node in tree.body:
        yield node
        if isinstance(node, ast.If | ast.Try):
            yield from node.body


def _imports(nodes: Iterator[ast.AST]) -> Iterator[str]:
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _circles(graph: Graph) -> int:
    """Return how many imports have to go until no file imports itself by way of others."""
    known = {name: set(others) for name, others in graph.items()}
    for count in range(sum(map(len, known.values())) + 1):
        try:
            TopologicalSorter(known).prepare()
        except CycleError as error:
            first, second = error.args[1][:2]  # the second imports the first
            known[second].discard(first)
        else:
            return count
    raise AssertionError("a graph without arrows has no circle")


def _reached(start: str, graph: Graph) -> set[str]:
    found, ahead = set(), [start]
    while ahead:
        name = ahead.pop()
        if name not in found:
            found.add(name)
            ahead += graph[name]
    return found


def _twice(trees: Mapping[str, ast.Module]) -> int:
    """Return how many names several classes have; each loop has a workspace of its own."""
    names = Counter(
        node.name
        for name, tree in trees.items()
        if _room(name) != "compiled"
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    return sum(count > 1 for count in names.values())


def _code_lines(path: Path) -> int:
    """Return the lines that are neither empty nor only comment or docstring."""
    text = path.read_text(encoding="utf-8")
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            lines.difference_update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(lines)


def _script_lines(path: Path) -> int:
    lines = (line.strip() for line in path.read_text(encoding="utf-8").splitlines())
    return sum(bool(line) and not line.startswith(("//", "/*", "*")) for line in lines)
