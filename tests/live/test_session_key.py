"""The key file: its permissions, its content and its refusals."""

import base64
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from haptether.bridge import LiveSlave, read_key, scene_json, wipe_key, write_key
from haptether.cli.live.sides import baseline_scene


def key_text(length: int = 32) -> str:
    return f"haptether session key 1\n{base64.b64encode(bytes(range(length))).decode()}\n"


def written(path: Path, text: str, mode: int = 0o600) -> Path:
    path.write_text(text)
    path.chmod(mode)
    return path


@pytest.mark.parametrize("umask", [0o000, 0o022, 0o077, 0o777])
def test_a_key_is_for_its_owner_alone_whatever_the_umask(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        write_key(tmp_path / "one.key")
        write_key(tmp_path / "two.key")
    finally:
        os.umask(before)
    for name in ("one.key", "two.key"):
        assert stat.S_IMODE((tmp_path / name).stat().st_mode) == 0o600
    one, two = read_key(tmp_path / "one.key"), read_key(tmp_path / "two.key")
    assert len(one) == len(two) == 32
    assert one != two


def test_the_known_answer(tmp_path: Path) -> None:
    text = "haptether session key 1\nAAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8=\n"
    assert text == key_text()
    assert read_key(written(tmp_path / "key", text)) == bytes(range(32))
    # A machine with other line ends wrote this file.
    assert read_key(written(tmp_path / "other", text.replace("\n", "\r\n"))) == bytes(range(32))
    assert read_key(written(tmp_path / "bare", text, 0o400)) == bytes(range(32))


@pytest.mark.parametrize(
    "key",
    [bytes(32), b"\x42" * 32, bytes(31) + b"\x01", bytes(range(4)) * 8],
    ids=["zeros", "one byte", "one bit", "pattern"],
)
def test_a_weak_key_is_refused_wherever_it_enters(tmp_path: Path, key: bytes) -> None:
    text = f"haptether session key 1\n{base64.b64encode(key).decode()}\n"
    with pytest.raises(ValueError, match=r"arm\.key: a weak key, \d different byte values: must be 32 random bytes"):
        read_key(written(tmp_path / "arm.key", text))
    for given in (key, bytearray(key)):
        with pytest.raises(ValueError, match="weak key"):
            LiveSlave(scene_json(baseline_scene()), listen="127.0.0.1:0", run_id=1, key=given)


def copies(pid: int, *secrets: bytes) -> int:
    """Return the number of copies of some bytes in the memory of a process."""
    found = 0
    proc = Path(f"/proc/{pid}")
    with (proc / "maps").open(encoding="ascii") as maps, (proc / "mem").open("rb", buffering=0) as memory:
        for line in maps:
            span, rights, *_ = line.split()
            if not rights.startswith("rw"):
                continue
            start, end = (int(number, 16) for number in span.split("-"))
            try:
                memory.seek(start)
                content = memory.read(end - start)
            except (OSError, ValueError, OverflowError):
                continue
            found += sum(content.count(secret) for secret in secrets)
    return found


HELD = """
import base64, ctypes, resource, sys, time
from pathlib import Path
from haptether.bridge import LiveMaster, LiveSlave, read_key, scene_json, wipe_key
from haptether.cli.live.sides import baseline_scene

def settled(port):
    key = read_key(Path(sys.argv[1]))
    scene = scene_json(baseline_scene(depth=0.0))
    slave = LiveSlave(scene, listen="127.0.0.1:0", run_id=1, key=key, realtime="off")
    master = LiveMaster(scene, peer=slave.address, run_id=2, key=key, realtime="off")
    wipe_key(key)
    end = time.monotonic() + 20.0
    while master.state == "disengaged" and time.monotonic() < end:
        time.sleep(0.01)
    return slave, master

sides = settled(0)
print(sides[1].state, ctypes.CDLL(None).prctl(3), resource.getrlimit(resource.RLIMIT_CORE)[0], flush=True)
sys.stdin.readline()
for side in sides:
    side.finish()
del sides
print("ended", flush=True)
sys.stdin.readline()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_live_process_has_one_copy_of_the_key_a_side_and_none_after_it(tmp_path: Path) -> None:
    path = tmp_path / "arm.key"
    write_key(path)
    # Search both forms: the key itself, and its text in the file.
    secrets = (bytes(read_key(path)), path.read_bytes().splitlines()[1])
    with subprocess.Popen(
        [sys.executable, "-c", HELD, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            state, dumpable, core = process.stdout.readline().split()
            held = copies(process.pid, *secrets)
            process.stdin.write("\n")
            process.stdin.flush()
            assert process.stdout.readline() == "ended\n"
            left = copies(process.pid, *secrets)
        finally:
            process.kill()
    assert state != "disengaged"
    # The process is not dumpable, and its core limit is 0.
    assert (dumpable, core) == ("0", "0")
    assert held == 2
    assert left == 0


def test_a_wiped_key_is_gone() -> None:
    key = bytearray(range(32))
    wipe_key(key)
    assert key == bytes(32)


def test_a_key_is_not_overwritten_by_accident(tmp_path: Path) -> None:
    path = written(tmp_path / "arm.key", key_text(), 0o644)
    with pytest.raises(FileExistsError, match=r"arm.key: is there already: --force replaces it"):
        write_key(path)
    assert path.read_text() == key_text()
    write_key(path, replace=True)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert read_key(path) != bytes(range(32))
    assert [entry.name for entry in tmp_path.iterdir()] == ["arm.key"]


def test_a_key_is_not_written_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(FileExistsError):
        write_key(tmp_path / "link")
    assert not (tmp_path / "elsewhere").exists()
    write_key(tmp_path / "link", replace=True)
    assert not (tmp_path / "link").is_symlink()
    assert not (tmp_path / "elsewhere").exists()


def test_a_folder_is_not_replaced(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="is a folder"):
        write_key(tmp_path, replace=True)


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o602, 0o666, 0o610])
def test_a_key_that_others_may_use_is_refused_with_the_remedy(tmp_path: Path, mode: int) -> None:
    path = written(tmp_path / "arm.key", key_text(), mode)
    with pytest.raises(ValueError, match=rf"\(mode {mode:04o}\): run `chmod 600 {path}`"):
        read_key(path)
    path.chmod(0o600)
    assert read_key(path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is no key file"),
        (key_text()[:-30], "line 2 is no base64 text"),
        (key_text().partition("\n")[2], "is no key file"),
        (key_text().replace("key 1", "key 2"), "is no key file"),
        (key_text() + key_text(), "is no key file"),
        (key_text(31), "a key of 31 bytes, must have 32"),
        (key_text(33), "a key of 33 bytes, must have 32"),
        ("haptether session key 1\n\n", "a key of 0 bytes, must have 32"),
        ("haptether session key 1\n!!!!\n", "line 2 is no base64 text"),
        (key_text() + " " * 5000, "is no key file"),
    ],
)
def test_what_holds_no_key_is_refused(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        read_key(written(tmp_path / "arm.key", text))


def test_what_is_no_plain_file_is_refused(tmp_path: Path) -> None:
    written(tmp_path / "arm.key", key_text())
    (tmp_path / "link").symlink_to("arm.key")
    with pytest.raises(ValueError, match="symbolic link"):
        read_key(tmp_path / "link")
    with pytest.raises(ValueError, match="no plain file"):
        read_key(tmp_path)
    os.mkfifo(tmp_path / "pipe", 0o600)
    with pytest.raises(ValueError, match="no plain file"):
        read_key(tmp_path / "pipe")
    with pytest.raises(FileNotFoundError):
        read_key(tmp_path / "missing")


def test_the_command_makes_a_key_and_keeps_one(tmp_path: Path) -> None:
    def keygen(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "haptether", "keygen", *arguments],
            cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip

    made = keygen()
    assert (made.returncode, made.stderr) == (0, "")
    key = read_key(tmp_path / "haptether.key")
    assert base64.b64encode(key).decode() not in made.stdout
    refused = keygen("haptether.key")
    assert refused.returncode == 1
    assert refused.stderr.startswith("haptether: haptether.key: is there already")
    assert refused.stderr.count("\n") == 1
    assert keygen("haptether.key", "--force").returncode == 0
    assert read_key(tmp_path / "haptether.key") != key
    assert keygen(".").stderr == "haptether: .: is a folder, must be a file\n"
    for options in ((), ("--force",)):
        nowhere = keygen("no/arm.key", *options)
        assert nowhere.returncode == 1
        assert nowhere.stderr == "haptether: no/arm.key: there is no folder no: make it first, or give another path\n"
