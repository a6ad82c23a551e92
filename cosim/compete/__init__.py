"""Where controllers are compared: released task sets, an entry per controller, and a leaderboard."""
