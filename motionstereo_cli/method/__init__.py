"""The paper and what it grew into: bands, motion, memory, matching; pure functions of arrays."""
