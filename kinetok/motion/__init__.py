"""Who moves and what is moved: characters, clips, libraries of clips, kinematics and file formats."""
