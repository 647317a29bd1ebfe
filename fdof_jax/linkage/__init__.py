"""What an arm is: its links and joints, its coordinates, and where it is singular."""
