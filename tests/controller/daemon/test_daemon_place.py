import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from controller.daemon.socket_lock import SocketLock
from model.errors import InputError


def test_the_socket_is_its_users_alone(tmp_path: Path) -> None:
    """Mode 0600 in a folder of mode 0700, whatever the umask; gone in the end."""
    before = os.umask(0)
    try:
        place = SocketLock(tmp_path / "new" / "era.sock")
        with place.bind():
            assert place.path.stat().st_mode & 0o777 == 0o600
            assert place.path.parent.stat().st_mode & 0o777 == 0o700
        assert os.umask(0) == 0
        place.release()
        assert not place.path.exists()
    finally:
        os.umask(before)


@pytest.mark.parametrize(("folder", "socket"), [(0o750, 0o660), (0o755, 0o600), (0o710, 0o660)])
def test_a_folder_that_is_a_groups(tmp_path: Path, folder: int, socket: int) -> None:
    """Where the folder is for a group and nobody else, so is the socket; never for everybody."""
    tmp_path.chmod(folder)
    place = SocketLock(tmp_path / "era.sock")
    with place.bind():
        assert place.path.stat().st_mode & 0o777 == socket
    place.release()


def test_a_socket_that_a_killed_daemon_left_is_no_obstacle(tmp_path: Path) -> None:
    """The lock goes with its process; the file that stays says nothing."""
    path = tmp_path / "era.sock"
    script = (
        "import os, sys; from pathlib import Path; "
        "from controller.daemon.socket_lock import SocketLock; "
        "place = SocketLock(Path(sys.argv[1])); place.bind(); os.kill(os.getpid(), 9)"
    )
    done = subprocess.run([sys.executable, "-c", script, str(path)], check=False)
    assert done.returncode == -9
    assert path.is_socket()
    place = SocketLock(path)
    place.bind().close()
    place.release()


def test_a_folder_where_others_may_write_is_refused(tmp_path: Path) -> None:
    """Or somebody could listen in our place."""
    folder = tmp_path / "open"
    folder.mkdir()
    folder.chmod(0o777)
    with pytest.raises(InputError, match="other users"):
        SocketLock(folder / "era.sock")


def test_a_link_of_somebody_elses_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It leads to a folder of ours today, and to theirs, with their socket in it, tomorrow."""
    (tmp_path / "ours").mkdir()
    link = tmp_path / "link"
    link.symlink_to("ours")
    SocketLock(link / "era.sock").release()
    theirs = os.stat_result((0o120777, *link.lstat()[1:4], os.getuid() + 1, *link.lstat()[5:10]))
    monkeypatch.setattr(Path, "lstat", lambda path: theirs)
    with pytest.raises(InputError, match="other users"):
        SocketLock(link / "era.sock")


def test_a_path_that_is_too_long_is_said_to_be(tmp_path: Path) -> None:
    """The system's own error would name no length."""
    with pytest.raises(InputError, match="at most 107 bytes"):
        SocketLock(tmp_path / ("x" * 120))


def test_two_places_in_one_folder_are_two(tmp_path: Path) -> None:
    """Each socket has its own lock."""
    places = [SocketLock(tmp_path / name) for name in ("a.sock", "b.sock")]
    for place in places:
        bound = place.bind()
        assert isinstance(bound, socket.socket)
        bound.close()
        place.release()


@pytest.mark.parametrize("what", ["file", "folder", "link"])
def test_what_is_no_socket_is_left_alone(tmp_path: Path, what: str) -> None:
    """It stays as it is, and is refused before anything is opened; no lock stays behind."""
    path = tmp_path / "there"
    match what:
        case "file":
            path.write_text("mine", encoding="utf-8")
        case "folder":
            path.mkdir()
        case _:
            path.symlink_to(tmp_path / "nowhere")
    with pytest.raises(InputError, match="is not a socket"):
        SocketLock(path)
    assert [each.name for each in tmp_path.iterdir()] == ["there"]
