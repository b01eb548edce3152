"""The method: bands, motion, memory and matching, as pure functions of arrays."""
