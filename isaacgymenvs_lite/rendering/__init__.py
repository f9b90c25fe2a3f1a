"""Pictures and videos of what figures do, without a screen: GL, scene, tracks, files."""
