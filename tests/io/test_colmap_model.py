from facts import raises

from recon_cli.errors import FormatError
from recon_cli.io.colmap_model import read_points_text

HEAD = "# 3D point list\n# Number of points: 3, mean track length: 2\n"
ROWS = ["1 0 0 1 9 9 9 0.5\n", "2 0 0 2 9 9 9 0.5\n", "3 0 0 3 9 9 9 0.5\n"]


def test_a_file_cut_between_two_lines_is_noticed_by_its_head(tmp_path):
    path = tmp_path / "points3D.txt"
    path.write_text(HEAD + "".join(ROWS))
    assert len(read_points_text(path)[0]) == 3
    path.write_text(HEAD + "".join(ROWS[:2]))
    with raises(FormatError, 2, 3, "promises"):
        read_points_text(path)


def test_a_file_without_a_head_promises_nothing(tmp_path):
    path = tmp_path / "points3D.txt"
    path.write_text("".join(ROWS[:2]))
    assert len(read_points_text(path)[0]) == 2
