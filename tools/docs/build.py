"""Build the site of the documents into out/site/html: `make docs`.

The lists of docs/README.md and docs/decisions/README.md are the navigation. The pages of commands, scene keys and
public names come from the parser, the tables of a scene and the docstrings.
"""

import contextlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from functools import partial
from pathlib import Path
from typing import Any

import griffe
import msgspec

from haptether.bridge import Scene
from haptether.bridge.scene.tables.ranges import LARGEST
from haptether.cli.entry import COMMANDS, GROUPS, parse

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).parent
OUT = ROOT / "out" / "site"
PAGES = OUT / "pages"
ITEM = re.compile(r"^- \[([^]]+)\]\(([^)#:]+)\)")
LINKED = re.compile(r"\]\(([^)#:]+)")
NAMED_BY_FILE = re.compile(r"\[[\w/.-]+(?:\.md|/)\]\(([^)#:]+\.md)\)")
TRANSITION = re.compile(r"(\S+) --> (\S+): (.*)")
ROOMS = ("safety", "netsim", "dynamixel", "master", "slave", "bridge", "studies", "view")
PACKAGES = ("haptether", *(f"haptether.{room}" for room in ROOMS))
DECISIONS = "docs/decisions/README.md"
SCENE_FILES = (
    "bridge/scene/tables/session.py",
    "bridge/scene/tables/master.py",
    "bridge/scene/tables/slave.py",
    "netsim/link/settings.py",
)
TABLE = re.compile(r"((?:`\[.+?\]`(?:, )?)*)(?:: )?(.*)", re.DOTALL)

Navigation = list[dict[str, Any]]


def copy_documents() -> None:
    """Copy the documents, and the files that they link to, to the places that they have in the repository."""
    shutil.copytree(ROOT / "docs", PAGES / "docs")
    for page in ROOT.glob("*.md"):
        shutil.copy(page, PAGES)
    for page in list(PAGES.rglob("*.md")):
        text = page.read_text("utf-8")
        for target in LINKED.findall(text):
            copy = Path(os.path.normpath(page.parent / target))
            source = ROOT / copy.relative_to(PAGES)
            if source.is_file() and not copy.exists():
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source, copy)
        text = re.sub(r"```mermaid\n(.*?)```", diagram_table, text, flags=re.DOTALL)
        text = re.sub(r"^\|.*", bare_bars, text, flags=re.MULTILINE)
        page.write_text(NAMED_BY_FILE.sub(partial(titled, page.parent), text), "utf-8")


def titled(folder: Path, link: re.Match[str]) -> str:
    """Return a link with the title of its page in place of the file name."""
    title = (folder / link[1]).read_text("utf-8").partition("\n")[0].removeprefix("# ")
    return f"[{title}]({link[1]})"


def diagram_table(diagram: re.Match[str]) -> str:
    """Return the transitions of a state diagram as a table: a script from elsewhere would have to draw them."""
    rows = [f"| {before} | {after} | {cause} |" for before, after, cause in TRANSITION.findall(diagram[1])]
    return "\n".join(["| from | to | when |", "|---|---|---|", *rows])


def write_commands() -> None:
    """Write the help of every command."""
    os.environ["COLUMNS"] = "96"
    names = [name for name in COMMANDS if name not in GROUPS]
    names += [f"{group} {name}" for group, commands in GROUPS.items() for name in commands]
    parts = ["# Options of every command", "`haptether help COMMAND` prints the same."]
    for name in names:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
            parse([*name.split(), "--help"])
        parts.append(f"## {name}\n\n```text\n{printed.getvalue().strip()}\n```")
    (PAGES / "docs" / "options.md").write_text("\n\n".join(parts) + "\n", "utf-8")


def write_keys() -> None:
    """Write the keys of a scene, a table each: types and ranges from the schema, the rest from the docstrings."""
    _, schemas = msgspec.json.schema_components([Scene], ref_template="{name}")
    classes = {name: found for file in SCENE_FILES for name, found in read(file).classes.items()}
    parts = ["# Keys of a scene", "Ranges include their ends. If no default is shown, see the meaning."]
    for name, schema in schemas.items():
        docstring = classes[name].docstring
        table, text = TABLE.match(docstring.value if docstring else "").groups()  # type: ignore[union-attr]
        kind = schema["properties"].get("kind", {}).get("enum", [])
        title = table or (f'`kind = "{kind[0]}"`' if len(kind) == 1 else name)
        parts += [f"## {title} {{ #{name.lower()} }}", text[:1].upper() + text[1:]]
        rows = []
        for key, of in schema["properties"].items():
            field = classes[name].members.get(key)
            meaning = " ".join(field.docstring.value.split()) if field and field.docstring else ""
            default = "required" if key in schema.get("required", []) else default_text(of.get("default"))
            rows.append(f"| `{key}` | {type_text(of)} | {default} | {in_cell(meaning)} |")
        if rows:
            parts.append("\n".join(["| key | type | default | meaning |", "|---|---|---|---|", *rows]))
    (PAGES / "docs" / "keys.md").write_text("\n\n".join(parts) + "\n", "utf-8")


def read(file: str) -> griffe.Module:
    """Return the classes and docstrings of a file."""
    path = ROOT / file
    return griffe.visit(path.stem, filepath=path, code=path.read_text("utf-8"))


def type_text(schema: dict[str, Any]) -> str:
    """Return the type and range of a JSON schema in words."""
    match schema:
        case {"$ref": name}:
            return f"[table](#{name.lower()})"
        case {"anyOf": choices}:
            return " or ".join(dict.fromkeys(type_text(one) for one in choices if one != {"type": "null"}))
        case {"enum": values}:
            return ", ".join(f"`{json.dumps(one)}`" for one in values)
        case {"type": "array", "items": items}:
            bounds = {schema.get("minItems", 0), schema.get("maxItems", "any")}
            count = f" {bounds.pop()}" if len(bounds) == 1 else ""
            return f"list of{count} ({type_text(items)})"
        case {"type": kind}:
            low = f"above {schema['exclusiveMinimum']:g}" if "exclusiveMinimum" in schema else ""
            if abs(schema.get("minimum", -LARGEST)) < LARGEST:
                low = f"from {schema['minimum']:g}"
            high = f"to {schema['maximum']:g}" if schema.get("maximum", LARGEST) < LARGEST else ""
            return " ".join(part for part in ("true, false" if kind == "boolean" else kind, low, high) if part)
    return "any"


def default_text(value: object) -> str:
    """Return a default as TOML has it; an absent key or a table of defaults is empty."""
    return "" if value in (None, {}) else f"`{json.dumps(value)}`"


def in_cell(text: str) -> str:
    """Escape the bars of a text outside its code."""
    return "`".join(part if i % 2 else part.replace("|", "\\|") for i, part in enumerate(text.split("`")))


def bare_bars(row: re.Match[str]) -> str:
    """Return a row of a table without the escapes that code hosts need for the bars of its code."""
    return "`".join(part.replace("\\|", "|") if i % 2 else part for i, part in enumerate(row[0].split("`")))


def write_packages() -> None:
    """Write one page a package, which the docstrings fill."""
    for package in PACKAGES:
        page = PAGES / "docs" / "api" / f"{package}.md"
        page.parent.mkdir(exist_ok=True)
        page.write_text(f"# {package}\n\n::: {package}\n", "utf-8")


def lists(index: str) -> Navigation:
    """Return the lists of an index, each by the heading above it."""
    found: Navigation = []
    for line in (ROOT / index).read_text("utf-8").splitlines():
        if line.startswith("## "):
            found.append({line.removeprefix("## "): []})
        elif item := ITEM.match(line):
            (pages,) = found[-1].values()
            pages.append({item[1]: os.path.normpath(Path(index).parent / item[2])})
    return found


def navigation() -> Navigation:
    """Return the lists of the index, with the pages that are made here beside those that they belong to."""
    made: dict[str, Navigation] = {
        "docs/commands.md": [{"Options of every command": "docs/options.md"}],
        "docs/scenes.md": [{"Keys of a scene": "docs/keys.md"}],
        "docs/python.md": [{"Python API": [{name: f"docs/api/{name}.md"} for name in PACKAGES]}],
        DECISIONS: lists(DECISIONS),
    }
    return [
        {section: [one for item in pages for one in (item, *made.get(next(iter(item.values())), []))]}
        for sections in lists("docs/README.md")
        for section, pages in sections.items()
    ]


def main() -> None:
    """Build the site."""
    shutil.rmtree(OUT, ignore_errors=True)
    copy_documents()
    write_commands()
    write_keys()
    write_packages()
    for file in ("style.css", "vendor/iframe-worker.js"):
        shutil.copy(HERE / file, PAGES)
    settings = tomllib.loads((HERE / "zensical.toml").read_text("utf-8"))["project"]
    # JSON is YAML.
    (OUT / "mkdocs.yml").write_text(json.dumps({**settings, "nav": navigation()}, indent=1), "utf-8")
    sys.exit(subprocess.run([sys.executable, "-m", "zensical", "build", "--strict"], cwd=OUT, check=False).returncode)


if __name__ == "__main__":
    main()
