"""The record of every tick: layout, writer process, reader."""
