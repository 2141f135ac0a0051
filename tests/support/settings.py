"""Settings of device and acoustics in one table, for tests that vary both."""

from dataclasses import fields, replace

from sonar_gl import Acoustics, Sonar

DEVICE = {field.name for field in fields(Sonar)}


def described(sonar: Sonar, profile: str = "physical", **settings) -> tuple[Sonar, Acoustics]:
    """Return the sonar and the acoustics of a profile, each with those of the settings that are fields of it."""
    mine = {key: value for key, value in settings.items() if key in DEVICE}
    others = {key: value for key, value in settings.items() if key not in DEVICE}
    return replace(sonar, **mine), Acoustics(profile, **others)
