from __future__ import annotations

from tests.bench.kept_figures import machine, verdict

RATIOS = {"yardstick": [10.0, 11.0], "a frame": [1.3, 1.0], "a keyframe": [4.7, 4.8]}


def test_slower_than_kept_is_a_warning_by_the_fastest_round() -> None:
    lines, warnings = verdict(RATIOS, {"a frame": 1.0, "a keyframe": 4.0})
    assert warnings == ["a keyframe: 18 % slower than kept; its rounds differ by 2 %"]
    assert [line.split()[-1] for line in lines[1:]] == ["1.00", "1.18"]
    assert lines[1].split()[2:5] == ["10.0", "30", "%"]


def test_figures_of_which_none_is_kept_are_no_warning() -> None:
    assert verdict(RATIOS, {})[1] == []


def test_machine_is_a_name_for_a_file() -> None:
    assert machine().endswith("cores") and "/" not in machine() and " " not in machine()
