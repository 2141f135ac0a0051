"""`python -m sonar_gl` is `sonar-gl`."""

from sonar_gl.cli.main import main

if __name__ == "__main__":
    main()
