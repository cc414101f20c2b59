"""Equations that the law and the plant share: gas, cylinder, valve, friction."""
