"""`haptether netsim compare`: netem shows its known quirks, and our emulation meets the request."""

import json
from typing import Any

import numpy as np
import pytest

from haptether.cli.entry import main
from haptether.netsim import GilbertElliott, LinkError, compare_netem, translate_netem

pytestmark = pytest.mark.slow

PACKETS = 200_000


def compared(capsys: pytest.CaptureFixture[str], text: str, *flags: str) -> dict[str, Any]:
    assert main(["netsim", "compare", text, "--packets", str(PACKETS), "--json", "-", *flags]) == 0
    printed = capsys.readouterr()
    report: dict[str, Any] = json.loads(printed.out)
    said = " ".join(printed.err.split())
    for word in ("asked", "netem", "ours", *report["quirks"]):
        assert word in said
    return report


def test_a_correlated_loss_all_but_ceases_and_ours_does_not(capsys: pytest.CaptureFixture[str]) -> None:
    report = compared(capsys, "delay 50ms 10ms 25% loss 1% 25%")
    asked, netem, ours = report["asked"], report["netem"], report["ours"]
    # sch_netem.c, measured: 0.0003 %, so that zero, one or two of 200000 packets are lost.
    assert netem["loss"] <= 5e-5
    assert asked["loss"] == 0.01
    # 1490 bursts of mean 1.347: the share deviates by 4 %.
    assert ours["loss"] == pytest.approx(0.01, rel=0.16)
    assert asked["mean_burst"] == pytest.approx(1.0 / (0.75 * 0.99))
    assert ours["mean_burst"] == pytest.approx(asked["mean_burst"], rel=0.1)
    # A jitter J without a distribution is uniform: J / sqrt(3).
    assert asked["sigma_s"] == pytest.approx(0.01 / np.sqrt(3.0))
    assert asked["p99_s"] == pytest.approx(0.0598)
    assert netem["reordered"] > 0.6
    assert ours["reordered"] == 0.0
    quirks = "\n".join(report["quirks"])
    for said in ("jitter is a half-width: 10 ms give a sigma of 5.774 ms", "the correlation of the delay does nothing",
                 "jitter reorders", "the correlation of loss narrows"):  # fmt: skip
        assert said in quirks


@pytest.mark.parametrize(
    ("text", "quirk"),
    [
        ("delay 10ms 10ms distribution normal", "a delay below zero is none: 15."),
        ("delay 100ms 10ms distribution pareto", "the table ends at four sigma: "),
        ("delay 2s", "limit: more than 1000 packets held"),
        ("delay 10ms 5ms rate 10mbit", "jitter reorders nothing"),
        ("rate 10mbit", "the delay runs while a packet waits"),
        ("duplicate 5% 50%", "the correlation of duplicate narrows"),
        ("corrupt 5% 50%", "the correlation of corrupt narrows"),
        ("delay 10ms reorder 25% 50%", "the correlation of reorder narrows"),
        ("delay 10ms reorder 25%", "what is reordered is sent without delay and overtakes all"),
        ("loss 5% duplicate 5%", "passes once"),
    ],
)
def test_each_quirk_is_reported_where_it_has_an_effect(
    text: str, quirk: str, capsys: pytest.CaptureFixture[str]
) -> None:
    report = compared(capsys, text)
    assert any(quirk in line for line in report["quirks"]), report["quirks"]
    assert report["arguments"] == text


@pytest.mark.parametrize(
    "text", ["delay 50ms", "loss 1%", "loss gemodel 1% 10% 70% 0.1%", "corrupt 1%", "duplicate 1%"]
)
def test_what_netem_does_as_asked_has_no_quirk(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["netsim", "compare", text, "--packets", "50000", "--json", "-"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["quirks"] == []
    assert "no quirk of netem acted" in printed.err


@pytest.mark.parametrize(
    ("text", "loss", "mean_burst"),
    [
        # The bad state lasts 1 / r packets, which are all lost: p / (p + r).
        ("loss gemodel 1% 10%", 0.01 / 0.11, 10.0),
        ("loss state 1% 25%", 0.01 / 0.26, 4.0),
        # Isolated losses: p14 / (1 + p14), each lost packet by itself.
        ("loss state 0% 100% 0% 0% 10%", 1.0 / 11.0, 1.0),
        ("loss 10%", 0.1, 1.0 / 0.9),
    ],
)
def test_what_a_chain_is_asked_for_is_its_stationary_state(text: str, loss: float, mean_burst: float) -> None:
    found = compare_netem(text, np.arange(PACKETS) * 1_000_000)
    assert found.asked.loss == pytest.approx(loss, rel=1e-9)
    assert found.asked.mean_burst == pytest.approx(mean_burst, rel=1e-9)
    # At least about 2000 bursts: both figures within 10 %.
    for figures in (found.netem, found.ours):
        assert figures.loss == pytest.approx(loss, rel=0.1)
        assert figures.mean_burst == pytest.approx(mean_burst, rel=0.1)


def test_a_translation_is_settings_of_a_link() -> None:
    settings = translate_netem("delay 20ms 5ms distribution pareto loss gemodel 1% 10% 70% 0.1% limit 50 rate 8mbit")
    assert (settings.delay_s, settings.jitter_s, settings.distribution) == (0.02, 0.005, "pareto")
    assert settings.gilbert_elliott == GilbertElliott(to_bad=0.01, to_good=0.1, loss_good=0.001, loss_bad=0.7)
    assert (settings.rate_bps, settings.queue_packets) == (8e6, 50)
    table = translate_netem("delay 20ms 5ms distribution paretonormal").distribution
    assert not isinstance(table, str)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["delay 50 x"], "netem: column "),
        (["dela 50ms", "--packets", "0"], "packets = 0: must be 1 to 5e+07"),
        (["slot 1ms"], "slot is not reproduced"),
        (["nonsense"], 'column 1: "nonsense" is no option'),
        (["rate 1mbit 0 48 5"], "cells have no equivalent"),
        (["delay 1ms", "--seed", "-1"], "seed = -1: must be between"),
        (["delay 1ms", "--rate", "nan"], "rate = nan: must be"),
        (["delay 1ms", "--size", "70000"], "size = 70000: must be 0 to 65535"),
    ],
)
def test_a_bad_request_is_one_line_and_status_2(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["netsim", "compare", *arguments]) == 2
    stderr = capsys.readouterr().err
    assert said in stderr
    assert stderr.count("\n") == 1


def test_the_error_is_that_of_a_link() -> None:
    with pytest.raises(LinkError, match="no option") as caught:
        translate_netem("nonsense")
    assert caught.value.key == "netem"
