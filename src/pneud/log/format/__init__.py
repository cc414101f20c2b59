"""What stands in a log: messages, schema, framing, state."""
