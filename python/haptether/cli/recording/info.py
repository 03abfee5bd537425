"""`haptether info`."""

from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from haptether.cli.shared.output import FileOptions

if TYPE_CHECKING:
    from haptether.bridge import Recording

EVENTS_SHOWN = 20


@dataclass(frozen=True, kw_only=True)
class Info(FileOptions):
    """Say what is in a recording: whose, how long, where the ladder stood, who tripped, why it held, what was set.

    Examples:

    haptether info master.mcap

    haptether info master.mcap slave.mcap --json -
    """

    files: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE [FILE ...]")]
    """Files of `--record`."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the same as JSON, with the scene; - for standard output."""

    def run(self) -> int:
        """Print each file.

        Raises:
            ValueError: A file is not a recording.
        """
        from haptether.bridge import load, read_recording
        from haptether.cli.recording.files import check_files
        from haptether.cli.scene.simulate import spinner
        from haptether.cli.shared.output import check_target, write_report
        from haptether.cli.shared.screen import screen
        from haptether.view.figures.events import merged_events

        if not self.files:
            message = "which file? Name what --record of master or slave wrote"
            raise ValueError(message)
        check_files(*self.files)
        check_target(self.json, force=self.force)
        console = screen(self.json)
        reports = []
        for file in self.files:
            with spinner(f"reading {file}"):
                recording = read_recording(file)
                run = load(recording)
            report = described(recording) | {"file": str(file), "events": run.events, "metrics": run.metrics}
            reports.append(report | {"settings": run.settings})
            _print_table(file, report, console)
            events = merged_events(run.events)
            for time_s, text in events[:EVENTS_SHOWN]:
                console.print_item(f"  {time_s:9.4f} s  {text}")
            if len(events) > EVENTS_SHOWN:
                console.print(f"  and {len(events) - EVENTS_SHOWN} more; --json has all events")
        write_report(self.json, reports)
        return 0


def described(recording: "Recording") -> dict[str, Any]:
    """Return the contents of a recording as numbers and names for JSON."""
    import numpy as np

    signals = recording.signals
    time_s = signals["time_ns"] * 1e-9
    ticks = len(time_s)
    states = Counter(signals["state"].tolist())
    begun = datetime.fromtimestamp(recording.begun_ns * 1e-9, UTC).isoformat() if recording.begun_ns else None
    return {
        "side": recording.side,
        "version": recording.version or None,
        "begun": begun,
        "whole": recording.whole,
        "problems": recording.problems,
        "security": recording.security,
        "ticks": ticks,
        "duration_s": float(time_s[-1] - time_s[0]) if ticks else 0.0,
        "period_s": float(np.median(np.diff(time_s))) if ticks > 1 else None,
        "latest_s": float(np.nanmax(signals["overshoot_s"])) if ticks else None,
        "axes": int(signals["position"].shape[1]) if signals["position"].ndim == 2 else 0,
        "states": {state: count / ticks for state, count in states.most_common()},
        "signals": sorted(signals),
        "causes": recording.causes,
    }


def _print_table(file: Path, report: dict[str, Any], console: Any) -> None:  # noqa: ANN401  # a Screen
    from haptether.cli.shared.table import Rows

    table = Rows(f"{file}", report["side"])
    metrics = report["metrics"]
    rows = {
        "begun": report["begun"],
        "Haptether": report["version"],
        "frames": "encrypted" if report["security"] == "secure" else "in plain sight",
        "file": "; ".join(report["problems"])
        or ("whole" if report["whole"] else "cut off: killed, or the disk was full"),
        "duration [s]": f"{report['duration_s']:.3f}",
        "ticks": f"{report['ticks']}",
        "axes": f"{report['axes']}" if report["ticks"] else None,
        "period, median [ms]": _milliseconds(report["period_s"]),
        "latest tick [ms]": _milliseconds(report["latest_s"]),
        "ladder": ", ".join(f"{state} {share:.1%}" for state, share in report["states"].items()) or None,
        "largest force on the hand [N]": _number(metrics.peak_device_force),
        "largest torque on the hand [N m]": _number(metrics.peak_device_torque),
        "time under intervention [s]": _number(metrics.intervention_s),
    }
    for name, text in rows.items():
        if text is not None:
            table.add(name, text)
    console.print(table)


def _number(value: float | None) -> str | None:
    return None if value is None else f"{value:.4g}"


def _milliseconds(value_s: float | None) -> str | None:
    return None if value_s is None else f"{value_s * 1e3:.3f}"
