"""Each example runs as it is written, and comes to the number that it came to before."""

import runpy
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent.parent / "examples"
NUMBERS = {  # what main() returns; its docstring says what that is
    "01_press_a_skin": 0.0722,
    "02_touch_with_a_tool": 0.0361,  # N
    "03_touch_with_a_force": 3.34e-3,  # m
    "04_two_fingers": 1.477e-3,  # m
    "05_your_own_method": 0.199,
    "06_judge_a_recording": 4.33e-5,  # m
    "07_how_stiff_is_it": 1400.0,  # Pa
    "08_a_haptic_loop": 0.0306,  # N
    "09_press_evenly": 9.63e-3,  # m
    "10_how_stiff_and_how_thick": 9.65e-3,  # m
    "11_many_at_once": 0.343,  # N
}
NEAR = 0.02  # relative: another processor, or a limb kept in single precision, moves the last digits


def test_every_example_has_its_number() -> None:
    assert sorted(NUMBERS) == sorted(path.stem for path in FOLDER.glob("*.py"))


@pytest.mark.parametrize("name", NUMBERS)
def test_an_example_comes_to_its_number(name: str) -> None:
    found = runpy.run_path(str(FOLDER / f"{name}.py"))["main"]()
    assert found == pytest.approx(NUMBERS[name], rel=NEAR)


@pytest.mark.parametrize("name", NUMBERS)
def test_an_example_is_short_and_says_what_it_shows(name: str) -> None:
    text = (FOLDER / f"{name}.py").read_text()
    assert len(text.splitlines()) < 60
    assert text.startswith(f'"""{name[:2]} ') and "\nPurpose: " in text and "\nShows: " in text
