"""The daemon's socket: reserved for one daemon, with permissions, in a safe place."""

import errno
import os
import socket
from pathlib import Path

import pytest

from controller.daemon.children import gateway_options
from controller.process.daemon_process import SocketLock
from long_form import full_disk
from model.errors import InputError


def test_socket_is_for_its_user_only(tmp_path: Path) -> None:
    """Mode 0600 in a folder of mode 0700 whatever the umask, which stays; removed at the end."""
    before = os.umask(0)
    try:
        lock = SocketLock(tmp_path / "new" / "era.sock")
        with lock.bind():
            for name in ("era.sock", "era.sock.lock"):
                assert lock.path.with_name(name).stat().st_mode & 0o777 == 0o600
            assert lock.path.parent.stat().st_mode & 0o777 == 0o700
        assert os.umask(0) == 0
        lock.release()
        assert not lock.path.exists()
    finally:
        os.umask(before)


def test_client_that_sees_the_socket_is_never_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not before it listens either: it appears under its name afterwards, whatever was left."""
    path = tmp_path / "era.sock"

    class Looking(socket.socket):
        def listen(self, *backlog: int) -> None:
            assert not path.exists()
            super().listen(*backlog)

    with socket.socket(socket.AF_UNIX) as killed:
        killed.bind(f"{path}~")  # by a daemon that was killed before it listened
    lock = SocketLock(path)
    monkeypatch.setattr(socket, "socket", Looking)
    with lock.bind(), socket.socket(socket.AF_UNIX) as client:
        client.connect(str(path))
    lock.release()
    assert [each.name for each in tmp_path.iterdir()] == ["era.sock.lock"]


def test_socket_that_cannot_listen_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither under its name nor under the one before."""

    class Deaf(socket.socket):
        def listen(self, *backlog: int) -> None:
            raise OSError(98, "Address already in use")

    lock = SocketLock(tmp_path / "era.sock")
    monkeypatch.setattr(socket, "socket", Deaf)
    with pytest.raises(InputError, match="Address already in use"):
        lock.bind()
    assert [each.name for each in tmp_path.iterdir()] == ["era.sock.lock"]
    lock.release()


@pytest.mark.parametrize(("folder", "mode"), [(0o750, 0o660), (0o755, 0o600), (0o710, 0o660)])
def test_socket_is_shared_with_group_of_its_folder(tmp_path: Path, folder: int, mode: int) -> None:
    """Only where the folder is closed to others."""
    tmp_path.chmod(folder)
    lock = SocketLock(tmp_path / "era.sock")
    with lock.bind():
        assert lock.path.stat().st_mode & 0o777 == mode
    lock.release()


def test_socket_lock_says_that_a_file_system_has_no_locks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As over a network; it is no second daemon."""

    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("fcntl.flock", no_locks)
    with pytest.raises(InputError, match=os.strerror(errno.ENOLCK)):
        SocketLock(tmp_path / "era.sock")


def test_full_disk_is_named_by_the_file_that_has_no_room(tmp_path: Path) -> None:
    """Under the socket, and under the dashboard's token."""
    path = tmp_path / "era.sock"
    with full_disk(at=0):
        with pytest.raises(InputError, match=f"{path}.lock"):
            SocketLock(path)
        with pytest.raises(InputError, match="dashboard-token"):
            gateway_options("127.0.0.1:0", path)
    SocketLock(path).release()


@pytest.mark.parametrize("kind", ["link", "pipe", "foreign"])
def test_socket_lock_cannot_be_prepared_by_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """A lock file must be a plain file of this user; others lose access to it."""
    lock = tmp_path / "era.sock.lock"
    match kind:
        case "link":
            lock.symlink_to("elsewhere")
        case "pipe":
            os.mkfifo(lock)
        case _:
            lock.touch(0o644)
            SocketLock(tmp_path / "era.sock").release()
            assert lock.stat().st_mode & 0o777 == 0o600
            monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    with pytest.raises(InputError, match=str(lock)):
        SocketLock(tmp_path / "era.sock")


def test_socket_lock_refuses_folder_that_others_can_write(tmp_path: Path) -> None:
    """Another user could listen there in the daemon's place."""
    folder = tmp_path / "open"
    folder.mkdir()
    folder.chmod(0o777)
    with pytest.raises(InputError, match=str(folder)):
        SocketLock(folder / "era.sock")


def test_socket_lock_refuses_symbolic_link_of_another_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its owner could redirect it to another folder later; a link of the same user is allowed."""
    (tmp_path / "ours").mkdir()
    link = tmp_path / "link"
    link.symlink_to("ours")
    SocketLock(link / "era.sock").release()
    theirs = os.stat_result((0o120777, *link.lstat()[1:4], os.getuid() + 1, *link.lstat()[5:10]))
    monkeypatch.setattr(Path, "lstat", lambda path: theirs)
    with pytest.raises(InputError, match=str(link)):
        SocketLock(link / "era.sock")


def test_socket_lock_refuses_path_too_long_for_a_socket(tmp_path: Path) -> None:
    """The system's own error would name no length."""
    room = 106 - len(str(tmp_path)) - 1
    with pytest.raises(InputError, match="106 bytes, got 107"):
        SocketLock(tmp_path / ("x" * (room + 1)))
    lock = SocketLock(tmp_path / ("x" * room))
    lock.bind().close()
    lock.release()


@pytest.mark.parametrize("kind", ["file", "folder", "link"])
def test_socket_lock_leaves_other_files_alone(tmp_path: Path, kind: str) -> None:
    """Whatever is no socket is refused before anything is created."""
    path = tmp_path / "there"
    match kind:
        case "file":
            path.write_text("mine", encoding="utf-8")
        case "folder":
            path.mkdir()
        case _:
            path.symlink_to(tmp_path / "nowhere")
    with pytest.raises(InputError, match=str(path)):
        SocketLock(path)
    assert [each.name for each in tmp_path.iterdir()] == ["there"]
