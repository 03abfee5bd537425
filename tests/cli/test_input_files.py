"""Readers of files: each one reads odd bytes or refuses them with the name of the file."""

import os
import re
import socket
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.recording.files import write_recording

from haptether.bridge import flight_of_file, load_population, load_scene, read_recording
from haptether.bridge.scene.series import read_series
from haptether.bridge.scene.sweeps.laws import measured_law
from haptether.bridge.session_key import read_key, write_key
from haptether.cli.netsim.link_options import LinkOptions
from haptether.dynamixel.arm.calibration import read_calibration as read_servos
from haptether.dynamixel.description.load import load_arm
from haptether.dynamixel.emulator.control import _path as read_lead
from haptether.netsim import DelayTrace, LinkSettings, Opportunities
from haptether.netsim.link.resolve import with_files
from haptether.slave.ur.kinematics.chain import read_calibration as read_arm
from haptether.slave.ur.kinematics.models import UR_MODELS
from haptether.view.saved import saved_run

ROOT = Path(__file__).parents[2]
BOM = b"\xef\xbb\xbf"


def shipped(path: str) -> bytes:
    return (ROOT / path).read_bytes()


def link(settings: LinkSettings) -> str:
    return msgspec.json.encode(with_files(settings, Path(), "forward")).decode()


def delays(path: Path) -> str:
    return link(LinkSettings(trace=DelayTrace(file=str(path))))


def opportunities(path: Path) -> str:
    return link(LinkSettings(opportunities=Opportunities(file=str(path))))


def key_of(path: Path) -> bytes:
    path.chmod(0o600)
    return bytes(read_key(path))


def a_key(folder: Path) -> bytes:
    write_key(folder / "made.key")
    return (folder / "made.key").read_bytes()


def npz(folder: Path, **arrays: list[float]) -> bytes:
    np.savez(folder / "made.npz", **arrays)  # type: ignore[arg-type]  # the other keyword is not an array
    return (folder / "made.npz").read_bytes()


FLIGHT = b'{"schema": 1, "side": "master", "transitions": [],\n "at_hold": [], "latest": []}\n'
SERVOS = b'baud = 1000000\n[[servo]]\nid = 1\nmodel = "XL330-M288"\nlow_rad = -1.5\nhigh_rad = 1.5\n'
IRTT = b"""{"round_trips": [
 {"seqno": 3, "lost": false, "delay": {"rtt": 2000}},
 {"seqno": 5, "lost": true}], "config": {"params": {"interval": 1000000}}}
"""


@dataclass(frozen=True)
class Reader:
    """A reader of files: its function, and a valid file."""

    name: str
    suffix: str
    read: Callable[[Path], Any]
    content: bytes | Callable[[Path], bytes]
    shifted: bytes | Callable[[Path], bytes] | None = None
    """The same file later in time; None for a file without times."""
    is_text: bool = True
    takes_links: bool = True

    def file(self, folder: Path, content: bytes | Callable[[Path], bytes] | None = None, name: str = "file") -> Path:
        made = self.content if content is None else content
        path = folder / f"{name}{self.suffix}"
        path.write_bytes(made if isinstance(made, bytes) else made(folder))
        return path


READERS = [
    Reader("scene", ".toml", load_scene, shipped("bridge/scenes/remote_push.toml")),
    Reader("scene of links", ".toml", lambda path: LinkOptions().links(str(path)),
           b"schema = 1\n[link.forward]\ndelay_s = 0.05\n"),
    Reader("population", ".toml", lambda path: repr(load_population(path)), shipped("bridge/populations/handle.toml")),
    Reader("measured column", ".csv", lambda path: measured_law(path, "k"), b"k,b\n100.5,1.0\n200.5,2.0\n"),
    Reader("recorded series, CSV", ".csv", read_series, b"time_s,x\n0.0,0.5\n0.5,1.0\n",
           b"time_s,x\n7.0,0.5\n7.5,1.0\n"),
    Reader("recorded series, npz", ".npz", read_series,
           lambda folder: npz(folder, time_s=[0.0, 0.5], values=[0.5, 1.0]),
           lambda folder: npz(folder, time_s=[7.0, 7.5], values=[0.5, 1.0]), is_text=False),
    Reader("arm", ".toml", load_arm, shipped("dynamixel/description/arms/koch-v1-1.toml")),
    Reader("calibration of servos", ".toml", read_servos, SERVOS),
    Reader("calibration of a UR arm", ".toml", lambda path: read_arm(path, UR_MODELS["ur5e"]),
           b"delta_a = [0.0001, 0.0, 0.0, 0.0, 0.0, 0.0]\n"),
    Reader("lead of emulated servos", ".csv", read_lead, b"time_s,1,2\n0.0,0.5,0.5\n0.5,1.0,0.25\n",
           b"time_s,1,2\n7.0,0.5,0.5\n7.5,1.0,0.25\n"),
    Reader("delays, CSV", ".csv", delays, b"time_s,delay_s\n0.0,0.05\n0.5,0.06\n1.0,lost\n",
           b"time_s,delay_s\n7.0,0.05\n7.5,0.06\n8.0,lost\n"),
    Reader("delays of IRTT", ".json", delays, IRTT, IRTT.replace(b'"seqno": 3', b'"seqno": 7003').replace(
        b'"seqno": 5', b'"seqno": 7005')),
    Reader("opportunities", ".trace", opportunities, b"1\n2\n4\n"),
    Reader("distribution", ".dist", lambda path: link(LinkSettings(distribution=str(path))), b"# of tc\n-5 0 5\n7 9\n"),
    Reader("key", ".key", key_of, a_key, takes_links=False),
    Reader("flight recorder", ".json", flight_of_file, FLIGHT),
    Reader("recording", ".mcap", lambda path: msgspec.json.encode(read_recording(path).meanings),
           lambda folder: write_recording(folder / "made.mcap", "master", [{}, {}]).read_bytes(), is_text=False),
    Reader("run", ".npz", lambda path: saved_run(path).signals["position"].tolist(),
           lambda folder: npz(folder, time_s=[0.0, 0.5], position=[0.5, 1.0]), is_text=False),
]  # fmt: skip
EVERY = pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)


def refusal(reader: Reader, path: Path) -> str:
    """Return the refusal of a file: one short line with the name of the file."""
    with pytest.raises((ValueError, OSError)) as raised:
        reader.read(path)
    text = str(raised.value)
    assert path.name in text
    assert "\n" not in text
    assert len(text) < 600 + len(str(path))
    return text


FORMS: dict[str, Callable[[bytes], bytes]] = {
    "byte order mark": lambda content: BOM + content,
    "CRLF": lambda content: content.replace(b"\n", b"\r\n"),
    "byte order mark and CRLF": lambda content: BOM + content.replace(b"\n", b"\r\n"),
    "no final newline": lambda content: content.rstrip(b"\n"),
}


@EVERY
@pytest.mark.parametrize("form", FORMS)
def test_a_text_is_read_in_each_form_that_editors_give_it(reader: Reader, form: str, tmp_path: Path) -> None:
    if not reader.is_text:
        pytest.skip("is no text")
    path = reader.file(tmp_path)
    wanted = reader.read(path)
    assert reader.read(reader.file(tmp_path, FORMS[form](path.read_bytes()), "other")) == wanted


@EVERY
def test_times_count_from_the_first_record(reader: Reader, tmp_path: Path) -> None:
    if reader.shifted is None:
        pytest.skip("has no times, or those of a run")
    assert reader.read(reader.file(tmp_path, reader.shifted, "later")) == reader.read(reader.file(tmp_path))


@EVERY
def test_a_link_is_followed_but_to_a_key(reader: Reader, tmp_path: Path) -> None:
    path = reader.file(tmp_path)
    linked = tmp_path / f"link{reader.suffix}"
    linked.symlink_to(path)
    if reader.takes_links:
        assert reader.read(linked) == reader.read(path)
    else:
        assert "symbolic link" in refusal(reader, linked)


def a_pipe(path: Path) -> None:
    os.mkfifo(path, 0o600)


def a_folder(path: Path) -> None:
    path.mkdir()


def a_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
    path.chmod(0o600)


def a_device(path: Path) -> None:
    """Create a device like `/dev/zero`, which never ends."""
    try:
        os.mknod(path, stat.S_IFCHR | 0o600, os.makedev(1, 5))
    except PermissionError:
        path.symlink_to("/dev/zero")


@EVERY
@pytest.mark.timeout(20)
@pytest.mark.parametrize("made", [a_pipe, a_folder, a_socket, a_device], ids=lambda made: made.__name__)
def test_what_is_no_plain_file_is_refused_at_once(reader: Reader, made: Callable[[Path], None], tmp_path: Path) -> None:
    path = tmp_path / f"file{reader.suffix}"
    made(path)
    assert re.search("pipe|folder|socket|device|plain file|symbolic link|directory", refusal(reader, path))


@EVERY
def test_a_file_that_cannot_be_read_or_is_not_there_is_named(reader: Reader, tmp_path: Path) -> None:
    path = tmp_path / f"file{reader.suffix}"
    refusal(reader, path)
    # Reading it fails with EIO, also for root.
    path.symlink_to("/proc/self/mem")
    refusal(reader, path)


@EVERY
@pytest.mark.parametrize(
    "content",
    [b"", b"\n", b"x" * (1 << 20), b"\xff\xfea\x00=\x001\x00", b"\xff\n", b"\x00" * 100, b"schema = 1\n" * 30_000],
    ids=["empty", "one newline", "huge line", "UTF-16", "no UTF-8", "zeros", "many lines"],
)
def test_a_file_of_something_else_is_refused(reader: Reader, content: bytes, tmp_path: Path) -> None:
    path = reader.file(tmp_path, content)
    path.chmod(0o600)
    refusal(reader, path)


@EVERY
def test_decimal_commas_are_refused(reader: Reader, tmp_path: Path) -> None:
    content = reader.file(tmp_path).read_bytes()
    with_commas = re.sub(rb"(\d)\.(\d)", rb"\1,\2", content)
    if not reader.is_text or (with_commas == content and reader.suffix not in {".trace", ".dist"}):
        pytest.skip("has no decimals")
    refusal(reader, reader.file(tmp_path, b"1,5\n" if with_commas == content else with_commas, "commas"))
