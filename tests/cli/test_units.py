"""The question about units, in every command that takes numbers of a scene: 50 instead of 0.05."""

import json
from pathlib import Path

import pytest

from haptether.cli.entry import main
from haptether.netsim import Controlled, ControlSocket, LinkSettings, ProxyStatistics

SHORT = ["--set", "run.duration_s=0.05"]
FORWARD = "link.forward.delay_s = 50: s, and beyond the usual 2; did you mean 0.05 (50 ms)?"
BACKWARD = FORWARD.replace("forward", "backward")
PUSH = "safety.limiter.max_force_n = 7900: N, and beyond the usual 200; did you mean 7.9 (7900 mN)?"
ASKED = {
    "simulate": (["simulate", "remote_push", *SHORT, "--link.forward.delay_s", "50"], [FORWARD]),
    "check": (["check", "remote_push", "--set", "safety.limiter.max_force_n=7900"], [PUSH]),
    "sweep --set": (["sweep", "remote_push", *SHORT, "--set", "link.forward.delay_s=50", "--samples", "1"], [FORWARD]),
    "sweep --vary": (["sweep", "remote_push", *SHORT, "--vary", "link.forward.delay_s=0.1:50:3"], [FORWARD]),
    "sweep --tie": (
        ["sweep", "remote_push", *SHORT, "--vary", "link.forward.delay_s=50", "--tie", "link.backward.delay_s"],
        [FORWARD, BACKWARD],
    ),
    "sweep of tables": (["sweep", "remote_push", *SHORT, "--vary", "link.backward={},{delay_s=50}"], [BACKWARD]),
    "sweep of draws": (
        ["sweep", "remote_push", *SHORT, "--samples=2", "--draw=safety.limiter.max_force_n=uniform:7900:7900.001"],
        [PUSH.split(" = ", maxsplit=1)[0]],
    ),
    "sweep of scenes": (["sweep", "remote_push", "--vary", "scene=slow.toml,remote_push", *SHORT], [FORWARD]),
    "evaluate": (
        ["evaluate", "free_motion", "--round-trip-s", "5", "--hands", "1", "--releases", "1", "--controller", "none",
         "--network", "steady", "--set", "safety.limiter.max_force_n=7900"],
        ["--round-trip-s 5: s, and beyond the usual 4; did you mean 0.005 (5 ms)?", PUSH],
    ),
    "netsim sample": (["netsim", "sample", "--delay-s", "50", "--packets", "10"], [FORWARD]),
    "netsim sample backward": (
        ["netsim", "sample", "--direction=backward", "--packets=9", "--delay-s=0.1", "--backward.delay-s", "50"],
        [BACKWARD],
    ),
    "netsim proxy": (
        ["netsim", "proxy", "--listen", "127.0.0.1:0", "--forward", "127.0.0.1:9", "--duration-s", "0", "--no-realtime",
         "--set", "delay_s=50"],
        [FORWARD, BACKWARD],
    ),
}  # fmt: skip


@pytest.mark.parametrize(("arguments", "asked"), ASKED.values(), ids=ASKED)
def test_a_unit_that_slipped_is_asked_about(
    arguments: list[str],
    asked: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    scene = (Path(__file__).parents[2] / "bridge" / "scenes" / "remote_push.toml").read_text(encoding="utf-8")
    (tmp_path / "slow.toml").write_text(scene.replace("delay_s = 0.05", "delay_s = 50", 1), encoding="utf-8")
    main(arguments)
    said = "".join(capsys.readouterr())
    assert [said.count(line) for line in asked] == [1] * len(asked)
    assert said.count("beyond the usual") == len(asked)


REFUSED = {
    "evaluate": (
        ["evaluate", "remote_push", "--quick", "--round-trip-s", "0", "100"],
        "--round-trip-s 100: must be 0 to 10 s; did you mean 0.1 (100 ms)?",
    ),
    "thresholds": (
        ["thresholds", "remote_push", "--round-trip-s", "100"],
        "--round-trip-s 100: must be 0 to 60 s; did you mean 0.1 (100 ms)?",
    ),
    "tune": (
        ["tune", "a.mcap", "--round-trip-s", "20000"],
        "--round-trip-s 20000: must be 0 to 10 s; did you mean 0.02 (20000 us)?",
    ),
    "below": (["evaluate", "remote_push", "--quick", "--round-trip-s", "-1"], "--round-trip-s -1: must be 0 to 10 s"),
    "falsify delay": (
        ["falsify", "remote_push", "--delay-s", "100"],
        "--delay-s 100: must be 0 to 2 s; did you mean 0.1 (100 ms)?",
    ),
    "falsify jitter": (
        ["falsify", "remote_push", "--jitter-s", "5"],
        "--jitter-s 5: must be 0 to 0.5 s; did you mean 0.005 (5 ms)?",
    ),
}


@pytest.mark.parametrize(("arguments", "said"), REFUSED.values(), ids=REFUSED)
def test_a_time_that_is_refused_is_asked_about_by_the_option_that_was_typed(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    assert "".join(capsys.readouterr()) == f"haptether: {said}\n"


@pytest.mark.parametrize(
    "arguments",
    [
        ["sweep", "remote_push", *SHORT, "--vary", "link.forward.delay_s=0.1:2:3"],
        ["netsim", "sample", "--delay-s", "0.05", "--packets", "10"],
    ],
)
def test_usual_numbers_are_not_asked_about(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    main(arguments)
    assert "usual" not in "".join(capsys.readouterr())


def test_a_change_of_a_running_proxy_is_asked_about(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    class Unmoved:
        def change(self, direction: str, settings: LinkSettings) -> None:
            del direction, settings

        def statistics(self) -> ProxyStatistics:
            raise NotImplementedError

    with ControlSocket(str(tmp_path / "control.sock")) as control:
        control.serve(Controlled(Unmoved(), LinkSettings(), LinkSettings(), lambda _: {}))
        assert main(["netsim", "set", "--control", control.address, "forward.delay_s=50"]) == 0
    said = capsys.readouterr().out
    assert FORWARD in said.replace("\n", " ")
    assert "forward.delay_s: not set -> 50.0" in said


def test_json_stays_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["netsim", "sample", "--delay-s", "50", "--packets", "10", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["packets"] == 10
