"""How the package is built; not used when it runs."""
