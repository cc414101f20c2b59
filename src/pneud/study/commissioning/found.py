"""What the steps of a commissioning have told, and what of it is to be written."""

from __future__ import annotations

from typing import NamedTuple

from pneud.config.models import Config
from pneud.loading import Loaded
from pneud.study.commissioning import slipping, written
from pneud.study.commissioning.estimated import Values
from pneud.study.commissioning.gains import Chosen
from pneud.study.commissioning.written import Change
from pneud.study.identification.estimating import Identified


class Found(NamedTuple):
    """What the steps have told."""

    identified: Identified
    estimates: Values  # to be written, gains apart
    believed: Config  # with these, and the gains that were there
    chosen: Chosen | None
    loaded: Loaded  # what the rig ran with
    source: str  # of what is found: log and date
    unexplained: list[str]  # what the model cannot explain

    @property
    def values(self) -> Values:
        """All that is to be written."""
        return self.estimates | ({} if self.chosen is None else self.chosen.values(self.believed))

    @property
    def cautions(self) -> list[str]:
        """What no gains can mend."""
        return [words for words in (slipping.caution(self.identified.parameters),) if words]

    @property
    def changes(self) -> list[Change]:
        """What that changes."""
        told = self.identified.parameters
        return written.changes(self.loaded.config, self.loaded.text, self.values, told)

    @property
    def text(self) -> str:
        """The configuration's text with all that.

        Raises:
            ConfigError: it is none that can be used.
        """
        return written.text_with(self.loaded.text, str(self.loaded.path), self.changes, self.source)
