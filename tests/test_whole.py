"""Files that are there whole or not at all."""

from pathlib import Path

import pytest

from swarm_mjcf.whole import WholeFile


def test_a_file_takes_its_place_when_it_is_done(tmp_path: Path):
    path = tmp_path / "new" / "a.txt"
    with WholeFile(path) as part:
        assert part.suffix == ".txt"
        part.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    assert list(path.parent.iterdir()) == [path]


def test_what_fails_leaves_the_older_file_and_nothing_else(tmp_path: Path):
    path = tmp_path / "a.txt"
    path.write_text("older")

    def interrupted() -> None:
        with WholeFile(path) as part:
            part.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "older"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_is_a_file_is_refused_as_the_system_says(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises((NotADirectoryError, FileExistsError)), WholeFile(tmp_path / "file" / "a.txt"):
        raise AssertionError("nothing can be written there")
