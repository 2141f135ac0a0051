"""The command line as its tests call it, and the small world and sonar that they try it on."""

import os

from click.testing import CliRunner

from sonar_gl.cli import main as cli

BODY = """<model name="{}"><static>true</static><pose>{} 0 0 0</pose><link name="link"><collision name="c">
<geometry><box><size>{}</size></box></geometry><laser_retro>255</laser_retro></collision></link></model>
"""
WALL, BOX = BODY.format("wall", "5.5 0 0", "1 20 20"), BODY.format("box", "3 0.5 0", "0.2 0.2 0.2")
SENSOR = '<model name="sonar"><link name="link"><sensor name="imaging_sonar" type="custom"/></link></model>'
SONAR = """frequency_hz = 900e3
n_beams = 24
n_bins = 80
azimuth_fov_deg = 40.0
elevation_fov_deg = 10.0
beam_width_deg = 2.0
range_min_m = 0.5
range_max_m = 8.5
"""


def run(*arguments):
    """(exit status, stdout, stderr) of a command line."""
    try:
        runner = CliRunner(mix_stderr=False)
    except TypeError:  # click 8.2 keeps them apart of itself
        runner = CliRunner()
    result = runner.invoke(cli.main, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


def ended(words: list[str], duration_s: float) -> list[str]:
    """Return the words of a command, with the options that end one that would go on for ever, or that may be taken."""
    command = cli.main
    for word in words:
        command = getattr(command, "commands", {}).get(word, command)
    options = {option for parameter in command.params for option in parameter.opts}
    more = {
        "--duration": duration_s,
        "--port": 0,
        "--domain": 100 + os.getpid() % 100,
    }  # programs beside tests have 0
    return [*words, *(text for name, value in more.items() if name in options for text in (name, str(value)))]
