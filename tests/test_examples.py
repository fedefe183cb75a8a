import runpy
from pathlib import Path

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def test_solve_and_doubt(capsys):
    runpy.run_path(str(EXAMPLES / "solve_and_doubt.py"))
    out = capsys.readouterr().out
    assert out.index(" USE: ") < out.index("DO_NOT_USE: ")


def test_window(capsys):
    runpy.run_path(str(EXAMPLES / "window.py"))
    out = capsys.readouterr().out
    assert "DO_NOT_USE" in out
    assert "explained by: runway " in out
    assert " m shorter" in out
    assert "by themselves so far: 0" in out


def test_exclude_a_corner(capsys):
    runpy.run_path(str(EXAMPLES / "exclude_a_corner.py"))
    assert "excluded" in capsys.readouterr().out
