"""`python -m sonar_gl` is `sonar-gl`, which begins here, so that Ctrl-C ends it by one line also while modules load.

To import this module sets that handler of Ctrl-C: it is for processes of a command alone.
"""

from sonar_gl.core.signals import exit_at_interrupt

exit_at_interrupt()

from sonar_gl.cli.main import main  # noqa: E402

if __name__ == "__main__":
    main()
