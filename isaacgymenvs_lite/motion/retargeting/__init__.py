"""Retargets motion capture of other skeletons to the humanoid or a robot by inverse kinematics."""
