"""The bus of Dynamixel servos, for leader arms and follower arms."""

__all__: list[str] = []
