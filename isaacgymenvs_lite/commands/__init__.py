"""Commands that stand on top of the package: check, demo, policies, alias."""
