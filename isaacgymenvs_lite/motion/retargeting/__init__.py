"""Motion capture of other skeletons, brought onto the humanoid by inverse kinematics."""
