"""What is hot on a CPU, in C++ (`cpp/`): compiled once a machine, loaded by ctypes. Torch's the reference."""
