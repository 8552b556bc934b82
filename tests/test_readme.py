"""The README's Python runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from lodestone import __version__

README = (Path(__file__).parents[1] / "README.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_code_block_runs(number, capsys):
    exec(compile(BLOCKS[number], f"README block {number}", "exec"), {})
    if "below the optimum" in BLOCKS[number]:
        gaps = [float(gap) for gap in re.findall(r"seed \d+: (\S+) below the optimum", capsys.readouterr().out)]
        assert len(gaps) == 2
        assert min(gaps) == 0


def test_the_citation_is_of_this_version():
    citation = (Path(__file__).parents[1] / "CITATION.cff").read_text()
    assert f"\nversion: {__version__}\n" in citation
