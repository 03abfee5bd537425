"""Count sentences that are hard to read, and fail where a room has more than its stored count.

Counted in comments, docstrings and documents:

- lines that begin with What, Of, Whether, Whoever or Such;
- sentences of more than 35 words.

The counts in tools/words.json may only fall.

    python tools/words.py           # compare
    python tools/words.py --list    # print each counted line
    python tools/words.py --write   # store lower counts
"""

import ast
import io
import json
import re
import subprocess
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
STORED = Path(__file__).with_suffix(".json")
MAX_WORDS = 35
OPENERS = re.compile(r"(What|Of|Whether|Whoever|Such)\b")
RUST_COMMENT = re.compile(r"\s*//[/!]? ?(.*)")
SENTENCE_END = re.compile(r"(?<=[.!?:;])\s+")
NEW_PARAGRAPH = re.compile(r"$|[-*|#>]|\d+\.\s|`{3}|\s{4}")

Lines = Iterator[tuple[int, str]]


def rust_lines(text: str) -> Lines:
    """Yield the comment lines of a Rust file, each with its line number."""
    for number, line in enumerate(text.splitlines(), 1):
        if found := RUST_COMMENT.match(line):
            yield number, found[1]


def python_lines(text: str) -> Lines:
    """Yield the lines of comments and docstrings of a Python file."""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string.lstrip("#").removeprefix(" ")
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and (doc := ast.get_docstring(node)):
            first = node.body[0].lineno
            yield from ((first + i, line) for i, line in enumerate(doc.splitlines()))


def document_lines(text: str) -> Lines:
    """Yield the lines of a Markdown file outside its code."""
    in_code = False
    for number, line in enumerate(text.splitlines(), 1):
        if line.lstrip().startswith("```"):
            in_code = not in_code
        elif not in_code and not line.startswith("    "):
            yield number, line


READERS = {".rs": rust_lines, ".py": python_lines, ".pyi": python_lines, ".md": document_lines}


def hard_lines(lines: Lines) -> Lines:
    """Yield lines that begin with an opener, and the first line of each long sentence."""
    paragraph: list[str] = []
    start = last = 0

    def long_sentences() -> Lines:
        for sentence in SENTENCE_END.split(" ".join(paragraph)):
            if len(sentence.split()) > MAX_WORDS:
                yield start, sentence

    for number, line in sorted(lines):
        if OPENERS.match(line.lstrip("-* ")):
            yield number, line
        if number != last + 1 or NEW_PARAGRAPH.match(line):
            yield from long_sentences()
            paragraph, start = [], number
        paragraph.append(line.strip())
        last = number
    yield from long_sentences()


def main() -> int:
    """Compare the counts with the stored ones; return 1 if one has risen."""
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True)
    counts: Counter[str] = Counter()
    for name in tracked.stdout.splitlines():
        reader = READERS.get(Path(name).suffix)
        if reader is None or not (ROOT / name).is_file():
            continue
        room = name.split("/")[0] if "/" in name else "."
        for number, line in hard_lines(reader((ROOT / name).read_text(encoding="utf-8"))):
            counts[room] += 1
            if "--list" in sys.argv:
                print(f"{name}:{number}: {line.strip()}")
    stored: dict[str, int] = json.loads(STORED.read_text(encoding="utf-8")) if STORED.exists() else {}
    risen = {room: count for room, count in counts.items() if count > stored.get(room, 0)}
    if "--write" in sys.argv:
        kept = {room: min(count, stored.get(room, count)) for room, count in sorted(counts.items())}
        STORED.write_text(json.dumps(kept, indent=2) + "\n", encoding="utf-8")
    elif risen:
        for room, count in risen.items():
            print(f"{room}: {count} hard sentences, at most {stored.get(room, 0)}", file=sys.stderr)
        print("run `python tools/words.py --list` and rewrite the new ones", file=sys.stderr)
        return 1
    print(f"{sum(counts.values())} hard sentences in {len(counts)} rooms: none more than stored")
    return 0


if __name__ == "__main__":
    sys.exit(main())
