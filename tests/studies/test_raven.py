"""The attacks of the RAVEN II study: the effect of each, and no motion or force in any hold."""

import contextlib
import json
from pathlib import Path

import pytest
from msgspec.structs import replace

from haptether.bridge import load_scene, scene_names, simulate
from haptether.cli.entry import main
from haptether.studies import RAVEN_ATTACKS, RavenReport, RavenRow, raven_suite
from haptether.studies.raven import COASTING_S, COMMAND_SPEED, SECURITY
from haptether.studies.raven_attacks import Security

SCENES = Path(__file__).resolve().parents[2] / "bridge" / "scenes" / "raven"


@pytest.fixture(scope="module")
def report() -> RavenReport:
    return raven_suite()


def row_of(report: RavenReport, scene: str, security: str) -> RavenRow:
    (row,) = (row for row in report.rows if (row.scene, row.security) == (f"raven_{scene}", security))
    return row


def test_every_attack_runs_on_every_kind_of_frames(report: RavenReport) -> None:
    expected = [(attack.scene, security) for attack in RAVEN_ATTACKS for security in SECURITY]
    assert [(row.scene, row.security) for row in report.rows] == expected
    assert sorted(path.stem for path in SCENES.glob("raven_*.toml")) == sorted(one.scene for one in RAVEN_ATTACKS)


def test_each_attack_does_what_it_is_known_to_do(report: RavenReport) -> None:
    seen = {(row.scene, row.security): row.effect for row in report.rows}
    assert seen == {(row.scene, row.security): row.expected for row in report.rows}


def test_without_a_key_what_is_altered_is_believed(report: RavenReport) -> None:
    works = {row.scene for row in report.rows if (row.security, row.works) == ("off", "yes")}
    assert works == {"raven_invert", "raven_scale", "raven_pose", "raven_hijack", "raven_feedback"}


def test_nobody_is_believed_without_the_key(report: RavenReport) -> None:
    assert not [row.scene for row in report.rows if (row.security, row.works) == ("on", "yes")]


def test_what_somebody_else_made_is_refused(report: RavenReport) -> None:
    """Check the counts: 1000 frames in a second, ten of them beyond limits; without a key only NaN is refused."""
    refused = {(row.scene.removeprefix("raven_"), row.security): row.refused for row in report.rows}
    for scene in ("invert", "scale", "pose", "feedback", "hijack"):
        assert refused[scene, "off"] == 0
        assert 1000 <= refused[scene, "on"] <= 1010
    assert refused["limits", "off"] == 0
    assert refused["limits", "on"] == 10
    for security in SECURITY:
        assert 2000 <= refused["nan", security] <= 2002
    for scene in ("drop", "delay", "creeping_delay", "reorder"):
        assert [refused[scene, security] for security in SECURITY] == [0, 0]


def test_whatever_holds_holds_still(report: RavenReport) -> None:
    for row in report.rows:
        assert (row.scene, row.moved_in_hold_mm, row.force_in_hold_n) == (row.scene, 0.0, 0.0)
        if row.effect == "stopped":
            assert set(row.final_states) <= {"hold", "stop"}


def test_a_displaced_pose_displaces_the_arm_by_as_much(report: RavenReport) -> None:
    """Check the displacement: 30 mm beyond the hand's turning point, at rest."""
    assert row_of(report, "pose", "off").astray_mm == pytest.approx(30.0, abs=0.1)


def test_a_hijacked_arm_goes_where_it_is_commanded(report: RavenReport) -> None:
    """Check the motion: 80 mm into the wall, until the slave no longer echoes the hand's frames: its news is old."""
    run = simulate("raven_hijack", overrides=SECURITY["off"])
    held = [event for event in run.events if event.kind == "hold"]
    assert held[0].detail == "master: peer's newest state is old"
    # The last echo arrives 20 ms after the attacker's first frame. Then follow 20 ms, a period of silence, ticks, and
    # the rest of the initial guess of the deviation, 40 ms * 20 ms / 580 ms. The slave receives the hold within 11 ms.
    assert 0.64 <= held[0].time_s <= held[1].time_s <= 0.64 + 0.006 + 0.011
    time_s, position = run.signals["time_s"], run.signals["position"]
    away_mm = 1e3 * abs(position[(time_s >= 0.6) & (time_s <= held[1].time_s)] + 0.08)
    assert away_mm.min() - 0.1 <= row_of(report, "hijack", "off").lag_mm <= away_mm.max() + 0.1


def test_forged_forces_are_felt(report: RavenReport) -> None:
    """Check the force: 6 N, less the peak force of the contact in a run without the attack."""
    overrides = [*SECURITY["off"], "link.backward.attacks=[]"]
    peak = simulate("raven_feedback", overrides=overrides).metrics.peak_device_force
    assert peak is not None
    assert row_of(report, "feedback", "off").extra_force_n == pytest.approx(6.0 - peak, abs=0.05)


@pytest.mark.parametrize("security", SECURITY)
def test_a_creeping_delay_holds_before_it_is_long(report: RavenReport, security: Security) -> None:
    """The sides hold at 48 ms more, the fourth step: at first they learn a part of the creep as normal delay.

    The lag is at most that at 1.875 L / T, the largest speed of a minimum-jerk path.
    """
    run = simulate("raven_creeping_delay", overrides=SECURITY[security])
    held = [event for event in run.events if event.kind == "hold"]
    assert "peer's newest state is old" in held[0].detail
    assert 0.6 < held[0].time_s < 0.85
    assert row_of(report, "creeping_delay", security).lag_mm <= 1e3 * 0.048 * 1.875 * 0.06 / 0.6


@pytest.mark.parametrize("security", SECURITY)
def test_a_command_beyond_all_limits_stops_nothing(report: RavenReport, security: Security) -> None:
    """Without a key one frame moves the command by one tick at its bound, and the hand continues."""
    row = row_of(report, "limits", security)
    assert row.final_states == ("engaged", "engaged")
    assert row.lag_mm <= row.astray_limit_mm
    if security == "off":
        assert row.lag_mm >= 1e3 * COMMAND_SPEED * 1e-3
    run = simulate("raven_limits", overrides=SECURITY[security])
    assert not {"hold", "stop", "fault"} & {event.kind for event in run.events}


REFUSED = {
    "off": ("raven_replay", "raven_nan"),
    "on": ("raven_replay", "raven_nan", "raven_hijack"),
}


@pytest.mark.parametrize(("security", "scene"), [(one, scene) for one in SECURITY for scene in REFUSED[one]])
def test_what_is_refused_changes_not_a_byte(security: Security, scene: str) -> None:
    nobody = ["link.forward.attacks=[]", *(["link.backward.attacks=[]"] if scene == "raven_nan" else [])]
    attacked = simulate(scene, overrides=SECURITY[security])
    alone = simulate(scene, overrides=[*SECURITY[security], *nobody])
    for name, values in attacked.signals.items():
        assert values.tobytes() == alone.signals[name].tobytes(), name


def test_the_limits_are_those_of_the_runs(report: RavenReport) -> None:
    """Check the limits: 20 ms of coasting at the hand's largest speed, and one tick at the bound of the command."""
    for row in report.rows:
        max_m = 1.875 * 0.06 / 0.6 * COASTING_S + COMMAND_SPEED * 1e-3
        assert 0.5 * max_m < row.astray_limit_mm * 1e-3 <= 1.1 * max_m
        assert row.extra_force_limit_n == pytest.approx(0.1 * row.astray_limit_mm)  # 100 N/m


def test_an_attack_that_does_something_else_is_reported(report: RavenReport) -> None:
    assert report.is_as_expected
    first, *rest = report.rows
    for wrong in (replace(first, effect="moved"), replace(first, moved_in_hold_mm=1e-9)):
        assert not RavenReport(rows=(wrong, *rest)).is_as_expected


def test_the_command_prints_and_writes_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["raven", "--json", "-"]) == 0
    said = capsys.readouterr()
    written = json.loads(said.out)
    assert written["is_as_expected"]
    assert {row["scene"] for row in written["rows"]} == {attack.scene for attack in RAVEN_ATTACKS}
    assert all(attack.scene.removeprefix("raven_").replace("_", " ") in said.err for attack in RAVEN_ATTACKS)


def test_every_scene_names_its_attack_and_its_source() -> None:
    for attack in RAVEN_ATTACKS:
        text = (SCENES / f"{attack.scene}.toml").read_text(encoding="utf-8")
        assert "Source: arXiv 1504.04339" in text, attack.scene
        assert load_scene(attack.scene).link is not None


def test_only_raven_lists_the_attacks(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["raven"]) == 0
    said = "".join(capsys.readouterr())
    assert all(attack.scene.removeprefix("raven_").replace("_", " ") in said for attack in RAVEN_ATTACKS)
    assert "raven_" in said
    for arguments in (["simulate", "--list"], ["list"], ["list", "--json", "-"], ["simulate", "raven_dro"], ["--help"]):
        with contextlib.suppress(SystemExit):
            main(arguments)
        said = "".join(capsys.readouterr())
        assert "raven_" not in said.replace("raven_dro:", ""), arguments
    assert not [name for name in scene_names() if "raven" in name]
    for command in (["simulate"], ["netsim", "sample", "--packets", "9"]):
        assert main([*command, "raven_drop", "--json", "-"]) == 0
