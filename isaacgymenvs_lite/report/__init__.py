"""What a run did, on one page: python -m isaacgymenvs_lite.report runs/<run>."""
