"""The command `batch` without a terminal: its progress is lines of a log."""

import io

from tqdm import tqdm

from sonar_gl.cli.batch import Lines


def test_a_bar_without_a_terminal_writes_lines():
    stream = io.StringIO()
    with tqdm(total=4, mininterval=0, miniters=1, ascii=True, ncols=60, file=Lines(stream)) as bar:
        for _ in range(4):
            bar.update()
            tqdm.write("a report", file=stream)
    lines = stream.getvalue().splitlines()
    assert "\r" not in stream.getvalue() and stream.getvalue().endswith("\n")
    assert lines.count("a report") == 4
    bars = [line for line in lines if line != "a report"]
    assert all("%|" in line and line == line.strip() for line in bars)
    assert bars[0].startswith("0%|") and bars[-1].startswith("100%")
