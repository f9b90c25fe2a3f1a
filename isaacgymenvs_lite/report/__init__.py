"""What a run did, on one page: isaacgymenvs-lite report runs/<run>."""
