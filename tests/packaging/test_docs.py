"""Code in the documents runs, and its references exist."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from haptether.cli import main

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
DECISIONS = ROOT / "docs" / "decisions"
SNIPPETS = [
    (page.name, snippet, shown)
    for page in PAGES
    for snippet, shown in re.findall(r"```python\n(.*?)```(?:\n\n```text\n(.*?)```)?", page.read_text(), re.DOTALL)
]
"""Page, code and the output that is shown below the code, or nothing."""


def test_there_are_snippets() -> None:
    assert len(SNIPPETS) >= 2


@pytest.mark.parametrize(("page", "snippet", "shown"), SNIPPETS)
def test_python_in_documents_runs(page: str, snippet: str, shown: str, tmp_path: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-W", "error", "-c", snippet],
        cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert ended.returncode == 0, f"{page}: {ended.stderr}"
    assert ended.stdout
    assert shown in {"", ended.stdout}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text()):
        assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_blocks_within_lists_are_where_every_renderer_sees_them(page: Path) -> None:
    """Four spaces for a paragraph or a fence, eight for code: less ends the list in some renderers."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    assert not re.findall(r"\n\n(?: {1,3}| {5,7})\S.*", text)


def test_each_decision_has_a_number_and_is_listed_once() -> None:
    listed = re.findall(r"^- \[[^]]+\]\((\d{3}-[a-z0-9-]+\.md)\)", (DECISIONS / "README.md").read_text(), re.MULTILINE)
    assert sorted(listed) == sorted(page.name for page in DECISIONS.glob("*.md") if page.name != "README.md")
    numbers = [name[:3] for name in listed]
    assert len(set(numbers)) == len(numbers)


def test_the_scene_of_the_page_can_be_built(tmp_path: Path) -> None:
    from haptether.bridge import load_scene

    text = re.findall(r"```toml\n(.*?)```", (ROOT / "docs/scenes.md").read_text(), re.DOTALL)[0]
    (tmp_path / "scene.toml").write_text(text)
    assert load_scene(tmp_path / "scene.toml").record is not None


SCENES = [
    (page.name, text)
    for page in PAGES
    for text in re.findall(r"```toml\n(.*?)```", page.read_text(), re.DOTALL)
    if text.startswith("schema = ")
]


@pytest.mark.parametrize(("page", "text"), SCENES, ids=[page for page, _ in SCENES])
def test_scenes_in_documents_can_be_built(page: str, text: str, tmp_path: Path) -> None:
    from haptether.bridge import load_scene

    (tmp_path / "scene.toml").write_text(text)
    assert load_scene(tmp_path / "scene.toml").schema == 1, page


@pytest.mark.parametrize(("page", "text"), SCENES, ids=[page for page, _ in SCENES])
def test_drivers_of_scenes_in_documents_are_accepted(page: str, text: str, tmp_path: Path) -> None:
    from haptether.bridge import load_scene
    from haptether.studies import check_scene

    (tmp_path / "scene.toml").write_text(text)
    found = check_scene(load_scene(tmp_path / "scene.toml"), remedies=False).findings
    of_drivers = [finding for finding in found if finding.name in {"master driver", "slave driver"}]
    # An arm needs a file of the user.
    wrong = [finding.text for finding in of_drivers if finding.state == "bad" and "calibrate" not in finding.text]
    assert not wrong, page
    assert len(of_drivers) == text.count("driver = ") + len(re.findall(r'device = "(?:ur|dynamixel)"', text))


def test_the_arm_of_the_page_is_the_one_that_is_emulated() -> None:
    from haptether.dynamixel.description import load_arm

    text = dict(SCENES)["dynamixel.md"]
    joints = load_arm("gello-ur").joints
    assert f"offsets = {[round(joint.offset_rad) for joint in joints]} " in text
    assert f"signs = {[joint.sign for joint in joints]}" in text


def test_the_arm_of_ones_own_has_every_key_and_the_torque_that_the_page_says(tmp_path: Path) -> None:
    import msgspec

    from haptether.dynamixel.description import ArmKinematics, load_arm
    from haptether.dynamixel.description.tables import ArmDescription, Joint, Link, Tool, Trigger

    page = (ROOT / "docs/dynamixel.md").read_text()
    (text,) = [one for one in re.findall(r"```toml\n(.*?)```", page, re.DOTALL) if one.startswith("name = ")]
    for table in (ArmDescription, Joint, Link, Tool, Trigger):
        for field in msgspec.structs.fields(table):
            assert re.search(rf"\b{field.name}( = |\]\]?)", text), (table.__name__, field.name)
    (tmp_path / "arm.toml").write_text(text)
    shoulder, elbow = ArmKinematics(load_arm(str(tmp_path / "arm.toml"))).gravity([0.0, 0.0])
    # m g r, for a positive turn about y, which moves the links down.
    assert elbow == pytest.approx(-0.1 * 9.81 * 0.1)
    assert shoulder == pytest.approx(-9.81 * (0.2 * 0.1 + 0.1 * 0.3))
    assert f"{0.1 * 9.81 * 0.1:.3f} N m" in page


def test_the_page_names_the_commands_without_json() -> None:
    from haptether.cli.entry import COMMANDS, GROUPS

    page = (ROOT / "docs/commands.md").read_text()
    (sentence,) = re.findall(r"Every command takes `--json PATH`.*?\.(?= Output)", page, re.DOTALL)
    named = set(re.findall(r"`([a-z -]+)`", sentence)) - {"-"}
    without = {
        name if group == "" else f"{group} {name}"
        for group, commands in {"": COMMANDS, **GROUPS}.items()
        for name, command in commands.items()
        if name not in GROUPS and not hasattr(command, "json")
    }
    assert {f"dynamixel {name}" if name == "calibrate" else name for name in named} == without


def shown_commands(page: Path) -> list[tuple[str, str]]:
    """Return command and arguments of each line of a page that begins with `haptether`."""
    pattern = r"^(?:\.venv/bin/|env/bin/)?haptether ((?:(?:netsim|dynamixel) )?[a-z0-9-]+)(.*?)(?:#|$)"
    return re.findall(pattern, page.read_text(), re.MULTILINE)


def test_the_page_of_commands_shows_every_command() -> None:
    from haptether.cli.entry import COMMANDS, GROUPS

    shown = {name.split()[0] for name, _ in shown_commands(ROOT / "docs/commands.md")}
    assert set(COMMANDS) - {"dynamixel"} <= shown
    network = {name.split()[1] for name, _ in shown_commands(ROOT / "docs/network.md") if name.startswith("netsim ")}
    assert network == set(GROUPS["netsim"])


@pytest.mark.parametrize(
    "page", ["README.md", *(f"docs/{name}.md" for name in ("commands", "first_finding", "install", "network"))]
)
def test_flags_of_shown_commands_exist(page: str, capsys: pytest.CaptureFixture[str]) -> None:
    for name, arguments in shown_commands(ROOT / page):
        flags = re.findall(r"--[a-z-]+", arguments)
        with pytest.raises(SystemExit):
            main([*name.split(), "--help"])
        text = capsys.readouterr().out
        assert all(flag in text for flag in flags), (name, flags)


def test_the_readme_starts_what_check_link_measures() -> None:
    (block,) = [one for one in re.findall(r"```sh\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
                if "haptether check-link" in one]  # fmt: skip
    before = block.partition("haptether check-link")[0]
    (peer, key) = re.findall(r"check-link --peer (\S+) --key (\S+)", block)[0]
    (slave,) = re.findall(rf"haptether slave --listen (\S+) --key {key}", before)
    assert f"haptether netsim proxy --listen {peer} --forward {slave}" in before
    assert f"haptether keygen {key}" in before


def test_it_is_said_how_many_hands_it_takes(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["evaluate", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    for text in (said, " ".join((ROOT / "docs/choosing.md").read_text().split())):
        assert re.search(r"hatched.*35 hands", text)
        assert "Few hands" in text or "few hands" in text


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120


def test_make_targets_of_the_documents_exist() -> None:
    makefile = (ROOT / "Makefile").read_text()
    for page in PAGES:
        for target in re.findall(r"(?:^|`)\s*make ([a-z]+)", page.read_text(), re.MULTILINE):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), (page.name, target)
