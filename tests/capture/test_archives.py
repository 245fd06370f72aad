"""Files that are neither video nor photo are refused with what to type."""

import io
import os
import shlex
import subprocess
import sys
import tarfile
import zipfile

import pytest
from facts import raises

from recon_cli.capture.known_files import is_archive, refuse_other_file
from recon_cli.errors import InputError


def pack(path):
    if path.suffix in (".zip", ".r3d"):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("a.jpg", b"picture")
    else:
        with tarfile.open(path, "w:gz" if path.name.endswith("gz") else "w") as archive:
            member = tarfile.TarInfo("a.jpg")
            member.size = 7
            archive.addfile(member, io.BytesIO(b"picture"))
    return path


@pytest.mark.integration
@pytest.mark.parametrize("name", [
    "my photos.zip", "scan.r3d", "room.tar", "room.tar.gz", "no_suffix"])
def test_an_archive_is_refused_with_the_command_that_unpacks_it(tmp_path, name):
    path = pack(tmp_path / name)
    assert is_archive(path)
    with raises(InputError, "archive", "video") as caught:
        refuse_other_file(path)
    command = caught.value.hint.split(": ", 1)[1].split(" && recon ingest ")
    program = shlex.split(command[0].split(" && ")[1])[0]
    if not any(os.access(os.path.join(place, program), os.X_OK)
               for place in os.environ["PATH"].split(os.pathsep)):
        pytest.skip(f"{program} is not installed")
    subprocess.run(["bash", "-c", command[0]], check=True, cwd=tmp_path)
    (folder,) = shlex.split(command[1])
    assert (tmp_path / folder / "a.jpg").read_bytes() == b"picture"


def test_an_archive_is_known_by_its_content(tmp_path):
    pack(tmp_path / "walk.zip").rename(tmp_path / "walk.mp4")
    with raises(InputError, "archive", "video"):
        refuse_other_file(tmp_path / "walk.mp4")


@pytest.mark.parametrize(("name", "text", "words"), [
    ("cameras.xml", "<document><chunk><cameras></cameras></chunk></document>", "Agisoft Metashape"),
    ("cams.csv", "#name,x,y,alt,heading,pitch,roll,f\n", "RealityScan"),
    ("odometry.csv", "timestamp, frame, x, y, z, qx, qy, qz, qw\n", "Stray Scanner"),
    ("notes.txt", "hello", "neither a video nor a photo"), ("room.ply", "ply", "recon import"),
    ("room.obj", "v 0 0 0", "a mesh")])
def test_poses_texts_and_scenes_are_no_videos(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as caught:
        refuse_other_file(tmp_path / name)
    assert words in caught.value.message + caught.value.hint
    assert caught.value.hint


def test_the_photos_beside_poses_are_proposed(tmp_path):
    (tmp_path / "poses.txt").write_text("0 0 0")
    (tmp_path / "a.jpg").touch()
    with pytest.raises(InputError) as caught:
        refuse_other_file(tmp_path / "poses.txt")
    assert f"recon ingest {shlex.quote(str(tmp_path))}" in caught.value.hint


@pytest.mark.parametrize("name", ["walk.mp4", "walk", "clip.gif", "walk.insv"])
def test_what_may_be_a_video_passes(tmp_path, name):
    (tmp_path / name).write_bytes(b"\0\0\0\x18ftypmp42")
    refuse_other_file(tmp_path / name)
    refuse_other_file(tmp_path / "gone.mp4")


@pytest.mark.skipif(sys.platform == "win32", reason="there are no named pipes in folders")
def test_a_pipe_is_not_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe.mp4")
    refuse_other_file(tmp_path / "pipe.mp4")
