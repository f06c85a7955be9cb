"""The likelihood of the rows about a reference position: profiles by sector, obstacles, shared and linear errors."""
