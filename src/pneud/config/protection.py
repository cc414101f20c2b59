"""How the frames of a message are protected: the rule for checksum and counter, and what it needs."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from pneud.config.sections import Section

Protection = Literal[
    "pneud", "sae-j1850", "crc8-h2f", "crc16-ccitt", "xor8", "sum8", "e2e-p01", "e2e-p02", "e2e-p05"
]
DataId = Annotated[int, Field(ge=0, le=0xFFFF)]
DataIdMode = Literal["both", "alternating", "low", "nibble"]
_DATA_IDS: dict[Protection, tuple[int, int]] = {  # how many, and up to what
    "e2e-p01": (1, 0xFFFF),
    "e2e-p02": (16, 0xFF),
    "e2e-p05": (1, 0xFFFF),
}


class ProtectionConfig(Section):
    """The rule by its name, and what of it is not in the frame."""

    protection: Protection = "pneud"  # rule for checksum and counter; "pneud": CRC-8 of identifier and data
    counter_max: Annotated[int, Field(ge=1)] | None = None  # 0 follows; by default its rule's, or all bits
    data_id: DataId | tuple[DataId, ...] | None = None  # of AUTOSAR's rules; sixteen for e2e-p02
    data_id_mode: DataIdMode = "both"  # how e2e-p01 takes it in
    data_id_nibble: str | None = None  # signal with bits 8 … 11 of it, in mode "nibble"

    @property
    def data_ids(self) -> tuple[int, ...]:
        """The identifiers that are not in the frame."""
        if self.data_id is None:
            return ()
        return self.data_id if isinstance(self.data_id, tuple) else (self.data_id,)

    @model_validator(mode="after")
    def _identifiers_of_the_rule(self) -> Self:
        given, nibble = self.data_ids, self.data_id_mode == "nibble"
        number, most = _DATA_IDS.get(self.protection, (0, 0))
        if len(given) != number or any(one > most for one in given):
            needs = f"{number or 'no'} data_id{f', up to {most}' if number else ''}"
            raise ValueError(f'protection = "{self.protection}" takes {needs}')
        if self.data_id_mode != "both" and self.protection != "e2e-p01":
            raise ValueError('data_id_mode is of protection = "e2e-p01"')
        if nibble != (self.data_id_nibble is not None):
            raise ValueError('data_id_mode = "nibble" and data_id_nibble, a signal of 4 bits, go together')
        if nibble and given[0] > 0xFFF:
            raise ValueError('data_id has 12 bits where data_id_mode = "nibble"')
        return self
