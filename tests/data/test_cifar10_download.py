"""The download of CIFAR-10: checked by its checksum, whole or not there, and refused where a copy is in the way."""

import hashlib
import http.server
import io
import tarfile
import tempfile
import threading
from pathlib import Path

import pytest
from hand_made_frames import BATCHES, write_cifar10

from infogoal_jax.cli.main import main
from infogoal_jax.data import backgrounds
from infogoal_jax.errors import UserError

pytestmark = pytest.mark.usefixtures("nothing_of_the_users")


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """An archive like CIFAR-10's, with two records in each batch."""
    folder = tmp_path_factory.mktemp("archive")
    write_cifar10(folder / backgrounds.CIFAR10_FOLDER, records=2)
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:gz") as members:
        members.add(folder / backgrounds.CIFAR10_FOLDER, backgrounds.CIFAR10_FOLDER)
    return packed.getvalue()


@pytest.fixture(scope="module")
def server(archive):
    """Address of a server on this machine: /whole is the archive, /half breaks off in the middle of it, other paths are
    not found."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200 if self.path in ("/whole", "/half") else 404)
            self.send_header("Content-Length", str(len(archive)))
            self.end_headers()
            self.wfile.write(archive if self.path == "/whole" else archive[: len(archive) // 2])

        def log_message(self, *arguments):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as serving:
        thread = threading.Thread(target=serving.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield f"http://127.0.0.1:{serving.server_port}"
        serving.shutdown()
        thread.join()


def test_a_download_with_the_right_checksum_can_be_loaded(tmp_path, server, archive):
    sha256 = hashlib.sha256(archive).hexdigest()
    batches = backgrounds.download_cifar10(tmp_path / "new" / "place", f"{server}/whole", sha256)
    assert sorted(path.name for path in (tmp_path / "new" / "place").rglob("*")) == sorted(
        [backgrounds.CIFAR10_FOLDER, *BATCHES]
    )
    assert len(backgrounds.load(tmp_path / "new" / "place").train) == 10
    # What is there is kept, without asking the server.
    assert backgrounds.download_cifar10(tmp_path / "new" / "place", f"{server}/nothing", sha256) == batches


def test_the_default_place_is_the_one_that_cifar10_names(server, archive):
    backgrounds.download_cifar10(url=f"{server}/whole", sha256=hashlib.sha256(archive).hexdigest())
    assert len(backgrounds.load("cifar10").test) == 2


def test_a_wrong_checksum_names_both_and_leaves_nothing(tmp_path, server, archive, capsys):
    assert main(["data", "download", "cifar10", str(tmp_path / "place"), "--url", f"{server}/whole"]) == 2
    message = capsys.readouterr().err
    assert all(
        part in message
        for part in ("cifar-10-binary.tar.gz", backgrounds.CIFAR10_SHA256, hashlib.sha256(archive).hexdigest())
    )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("page, reason", [("half", "broke off"), ("nothing", "404")])
def test_a_download_that_breaks_off_leaves_nothing(tmp_path, server, capsys, page, reason):
    (tmp_path / "place").mkdir()
    assert main(["data", "download", "cifar10", str(tmp_path / "place"), "--url", f"{server}/{page}"]) == 2
    assert reason in capsys.readouterr().err
    assert not list((tmp_path / "place").iterdir())


def test_a_download_that_the_user_stops_leaves_nothing(tmp_path, monkeypatch):
    def stopped(url, file, *others):
        Path(file).write_bytes(b"the first bytes")
        raise KeyboardInterrupt

    monkeypatch.setattr(backgrounds, "stream", stopped)
    with pytest.raises(KeyboardInterrupt):
        backgrounds.download_cifar10(tmp_path / "place")
    assert not list(tmp_path.iterdir())


def test_an_archive_of_something_else_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(backgrounds, "stream", lambda url, file, *others: Path(file).write_bytes(b"no archive"))
    with pytest.raises(UserError, match="not the archive of CIFAR-10's binary version"):
        backgrounds.download_cifar10(tmp_path / "place", sha256=hashlib.sha256(b"no archive").hexdigest())
    assert not list(tmp_path.iterdir())


def test_a_damaged_copy_is_not_downloaded_over(tmp_path):
    write_cifar10(tmp_path / backgrounds.CIFAR10_FOLDER)
    (tmp_path / backgrounds.CIFAR10_FOLDER / "data_batch_1.bin").unlink()
    with pytest.raises(UserError, match="without data_batch_1.bin"):
        backgrounds.download_cifar10(tmp_path)


def test_a_place_that_cannot_be_written_to_is_named(tmp_path, monkeypatch, capsys):
    (tmp_path / "a_file").touch()
    assert main(["data", "download", "cifar10", str(tmp_path / "a_file" / "inside")]) == 2
    assert "cannot be written to" in capsys.readouterr().err

    def forbid(*arguments):
        raise PermissionError(13, "Permission denied", str(tmp_path))

    monkeypatch.setattr(tempfile, "mkdtemp", forbid)
    with pytest.raises(UserError, match="path = '.*place'.*cannot be written to: Permission denied"):
        backgrounds.download_cifar10(tmp_path / "place")


@pytest.mark.parametrize(
    "words, parts",
    [
        ("cifar100", ["cifar100", "Known: cifar10"]),
        ("", ["Known: cifar10"]),
        ("cifar10 place --url ftp://somewhere", ["url = 'ftp://somewhere'", "http://"]),
        ("cifar10 place --url http://", ["url = 'http://'", "broke off"]),
    ],
)
def test_mistakes_in_the_command_are_named(capsys, words, parts):
    assert main(["data", "download", *words.split()]) == 2
    message = capsys.readouterr().err
    assert all(part in message for part in parts)
