"""A generator of walking and running clips from published gait data (see docs/shipped_clips.md)."""
