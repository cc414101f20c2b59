"""The loop's records, as a client of its daemon reads them: the memory that `attach` hands over."""

from __future__ import annotations

import os
from typing import Any

from pneud.console.client import Client
from pneud.console.endpoint import PlaceError
from pneud.log.live.ring import Ring


def attached(client: Client) -> tuple[dict[str, Any], Ring]:
    """The fields of `attach`, and the ring.

    Raises:
        RefusedError: the daemon gives none.
        PlaceError: the daemon has gone, does not answer, or lays records out otherwise.
    """
    fields, descriptor = client.attach()
    if fields["layout"] != Ring.layout():
        os.close(descriptor)
        raise PlaceError("the daemon runs another version of pneud; restart it", 1)
    return fields, Ring.attach(descriptor, fields["slots"], fields["slot_bytes"])
