"""`python -m sonar_gl` is `sonar-gl`, which begins here, so that Ctrl-C ends it by one line also while modules load."""

from sonar_gl.core.signals import exit_at_interrupt

exit_at_interrupt()

from sonar_gl.cli.main import main  # noqa: E402

if __name__ == "__main__":
    main()
