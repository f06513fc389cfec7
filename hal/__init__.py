"""What a robot is: types, `Arm` and `Gripper`, profiles, models, and the CAN drivers."""
