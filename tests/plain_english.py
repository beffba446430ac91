"""Check the English of docstrings, comments, messages and pages: `python tests/plain_english.py [PATH...]`, part of `make lint`.

codespell rejects single words (.codespell-house-words.txt); this script rejects phrases and openings that a word list
cannot express.
"""

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SUFFIXES = {".py", ".md", ".msg", ".yaml", ".yml", ".j2"}
PHRASES = {
    "write 'continue' or 'resume'": r"\b(go|goes|gone|going|went) on\b",
    "name the quantity": r"\b[Ss]o ((much|many|long|often|near)\b(?! (as|that)\b)|far (from|below|above|off)\b)",
    "write 'is not a'": r"(?<!\b[Tt]here )\b(is|are) no (?!(longer|more|less|other|match)\b)[a-z]+",
    "write 'current', 'previous', 'recent'": r"\bof (now|then|before|late)\b",
    "write 'during'": r"\bin mid-\w+",
    "write 'result of', 'built from'": r"\b(comes?|came|makes?) of\b",
    "write 'message' or 'report'": r"\b(newest|no|conductor's|operator's|perception's|another|their|its) words?\b",
    "write 'in wall-clock mode'": r"\bby the wall clock\b",
    "write 'user-defined', 'custom', 'its own'": r"\bone's own\b",
    "write 'report', 'state', 'publish'": r"\btell\b(?! apart\b)",
    "write 'has an error of'": r"\berr(ed)?\b",
    "write 'plan', 'place', 'is at'": r"\b(lay|laid|lain)\b(?! (out|off)\b)",
}
COMPILED = {hint: re.compile(pattern) for hint, pattern in PHRASES.items()}
OPENING = re.compile(r"^(What|Whether|How|Where|Who|Why|Which|So)\b")
CHAIN = re.compile(r"^\.\.\.|\.\.\.$")
NAMES = re.compile(r"(^|_)(heed|told|untold|tells?|hear|heard|laid|anew|whoever|nobody|somebody|seldom)(_|$)")
MESSAGE_SPACES = 2
"""A string with more spaces than this is a message."""


def python_texts(source: str) -> Iterator[tuple[int, str, str]]:
    """Yield line, text and kind ("docstring", "name" or "text") of docstrings, comments, messages and names."""
    tree = ast.parse(source)
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}  # and other strings that stand alone
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            if id(node) in docstrings:
                yield node.lineno, node.value, "docstring"
            elif node.value.count(" ") > MESSAGE_SPACES:
                yield node.lineno, node.value, "text"
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and NAMES.search(node.name):
            yield node.lineno, node.name, "name"
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string.lstrip("# "), "text"


def prose(source: str) -> Iterator[tuple[int, str, str]]:
    """Yield line, text and kind of every line of a page, without code and link targets."""
    fenced = False
    for number, line in enumerate(source.splitlines(), 1):
        fenced ^= line.startswith("```")
        if not fenced and not line.startswith("    "):
            yield number, re.sub(r"`[^`]*`|\]\([^)]*\)", " ", line), "text"


def faults(path: Path) -> Iterator[str]:
    """Yield one line for each phrase of a file that breaks a rule."""
    source = path.read_text(encoding="utf-8")
    texts = {".py": python_texts, ".md": prose}.get(
        path.suffix, lambda s: ((n, t, "text") for n, t in enumerate(s.splitlines(), 1))
    )
    for line, text, kind in texts(source):
        shown = f"{path.relative_to(ROOT)}:{line}"
        flat = " ".join(re.sub(r"`[^`]*`", " ", text).split()) if kind != "name" else text
        if kind == "name":
            yield f"{shown}: a house word in a name: {flat}"
            continue
        if kind == "docstring" and (OPENING.search(flat) or CHAIN.search(flat)):
            yield f"{shown}: open with a verb or a noun phrase, no chained sentences: {flat[:80]}"
        for hint, pattern in COMPILED.items():
            for found in pattern.finditer(flat):
                yield f"{shown}: {hint}: ...{flat[max(0, found.start() - 30) : found.end() + 30]}..."


def main(arguments: list[str]) -> int:
    """Check the files in git, or those under the paths given; return 1 if any rule is broken."""
    listed = subprocess.run(["git", "ls-files", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    skipped = {Path(__file__), ROOT / "LICENSE"}
    paths = [ROOT / name for name in listed.splitlines() if Path(name).suffix in SUFFIXES]
    broken = [fault for path in paths if path.is_file() and path not in skipped for fault in faults(path)]
    print("\n".join(broken) or "plain English: no fault")
    if broken:
        print(f"{len(broken)} places need plain English")
    return bool(broken)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
