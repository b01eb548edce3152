"""The paper, one section a file: pure functions of arrays."""
