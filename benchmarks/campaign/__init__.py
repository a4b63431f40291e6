"""Campaign: runs again what the documentation claims, and says which claims hold by the present code."""
