"""The tutorial runs as it stands, and says what comes out."""

from __future__ import annotations

import re
from pathlib import Path

TUTORIAL = (Path(__file__).parents[1] / "docs" / "tutorial.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", TUTORIAL, flags=re.DOTALL)


def test_its_program_runs(capsys):
    names: dict = {"__name__": "tutorial"}
    for number, block in enumerate(BLOCKS):
        exec(compile(block, f"tutorial block {number}", "exec", dont_inherit=True), names)
    printed = capsys.readouterr().out
    assert "16 states; the optimum takes 11 steps and returns 10" in printed
    flat, better = (
        (float(first), float(decisions))
        for first, decisions in re.findall(r"return (\S+); in the end (\S+) decisions", printed)
    )
    assert better[0] > flat[0]
    assert better[1] < flat[1]
    assert re.search(r"20 steps, a discounted reward of 18\.21, to be followed by a discount of 0\.82", printed)
