"""Network testbed: two machines emulated on one computer.

Only an emulated radio connects them, with delay, rate, loss and outages.
"""
