"""What a status says, for a plant's broker: nothing here commands, or listens to anybody but the broker."""
