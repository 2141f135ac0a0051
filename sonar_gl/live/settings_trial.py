"""Settings of a live session that are taken back if no ping can be made with them."""

from __future__ import annotations

from sonar_gl.live.settings import LiveSettings


class SettingsTrial:
    """The settings of the next ping, and the last ones that a ping was made with. To be used by one thread at a time.

    Parameters
    ----------
    settings : LiveSettings of the first ping, to which there are none to go back

    Attributes
    ----------
    settings : LiveSettings of the next ping
    """

    def __init__(self, settings: LiveSettings):
        self.settings = self._proven = settings
        self._settings_problem = self._ping_problem = ""

    @property
    def problem(self) -> str:
        """A sentence about why the last settings were not taken, or the last ping failed; "" if all is well."""
        return self._settings_problem or self._ping_problem

    def change(self, settings: LiveSettings) -> None:
        """Take other settings for the next ping."""
        self.settings, self._settings_problem = settings, ""

    def succeed(self, settings: LiveSettings) -> None:
        """Note that a ping was made with some settings."""
        self._proven, self._ping_problem = settings, ""

    def fail(self, settings: LiveSettings, problem: str) -> bool:
        """Note why a ping failed with some settings, and take them back unless others have come since.

        Returns whether other settings may be tried at once: the failure is not that of settings that worked before.
        """
        if settings == self._proven:
            self._ping_problem = problem
            return False
        if settings == self.settings:
            self.settings, self._settings_problem = self._proven, problem
        return True
