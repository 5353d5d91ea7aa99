from __future__ import annotations

from failuretwin.core.foreign import files_below


def test_linked_folders_are_searched_and_circles_end(tmp_path):
    logs, elsewhere = tmp_path / "logs", tmp_path / "elsewhere"
    (logs / "a").mkdir(parents=True)
    elsewhere.mkdir()
    (logs / "a" / "one.csv").write_text("")
    (elsewhere / "two.csv").write_text("")
    (elsewhere / "other.txt").write_text("")
    (logs / "linked").symlink_to(elsewhere)
    (logs / "a" / "back").symlink_to(logs)
    found = {path.relative_to(logs).as_posix() for path in files_below(logs, "*.csv")}
    assert found == {"a/one.csv", "linked/two.csv"}
