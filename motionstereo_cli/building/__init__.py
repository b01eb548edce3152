"""The build of the package; not used at run time."""
