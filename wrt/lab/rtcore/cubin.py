"""What a CUDA binary tells without any of NVIDIA's tools: code, registers, stack and instructions of a kernel.

Volta and what came after it have instructions of 16 bytes. Their lowest 9 bits name the operation; NVIDIA never published which is
which. OPERATIONS was read off binaries of known source (Jia et al. 2019, "Dissecting the NVIDIA Turing T4 GPU via
Microbenchmarking", did so first), and a test compiles some of it again. What is not in it counts as "other".
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass

from wrt.core.errors import InputError

# By class, the operations that Turing has for it.
CLASSES: dict[str, dict[int, str]] = {
    "fp32": {0x020: "FMUL", 0x021: "FADD", 0x023: "FFMA", 0x009: "FMNMX", 0x00B: "FSETP", 0x00A: "FSET", 0x008: "FSEL"},
    "fp64": {0x028: "DMUL", 0x029: "DADD", 0x02A: "DSETP", 0x02B: "DFMA"},
    "special": {0x108: "MUFU", 0x102: "FCHK"},
    "integer": {0x010: "IADD3", 0x024: "IMAD", 0x025: "IMAD.WIDE", 0x027: "IMAD.HI", 0x00C: "ISETP", 0x012: "LOP3", 0x019: "SHF",
                0x011: "LEA", 0x017: "IMNMX", 0x007: "SEL", 0x013: "IABS", 0x016: "PRMT", 0x01C: "PLOP3", 0x109: "POPC",
                0x100: "FLO"},
    "convert": {0x104: "F2F", 0x105: "F2I", 0x106: "I2F", 0x107: "FRND", 0x110: "F2F.64", 0x111: "F2I.64", 0x112: "I2F.64"},
    "move": {0x002: "MOV", 0x003: "P2R", 0x004: "R2P", 0x005: "CS2R", 0x119: "S2R", 0x1C2: "R2UR", 0x1C3: "S2UR"},
    "uniform": {0x082: "UMOV", 0x086: "UP2UR", 0x08C: "UISETP", 0x090: "UIADD3", 0x092: "ULOP3", 0x099: "USHF", 0x0A4: "UIMAD",
                0x0A5: "UIMAD.WIDE", 0x0B9: "ULDC", 0x0BE: "R2UR"},
    "load": {0x180: "LD", 0x181: "LDG", 0x182: "LDC", 0x183: "LDL", 0x184: "LDS"},
    "store": {0x185: "ST", 0x186: "STG", 0x187: "STL", 0x188: "STS", 0x18E: "RED"},
    "control": {0x118: "NOP", 0x141: "BSYNC", 0x142: "BREAK", 0x143: "CALL.ABS", 0x144: "CALL", 0x145: "BSSY", 0x146: "YIELD",
                0x147: "BRA", 0x148: "WARPSYNC", 0x14D: "EXIT", 0x150: "RET", 0x155: "BMOV", 0x156: "BMOV.64", 0x101: "BMOV.R"},
}
CLASS_OF = {number: name for name, operations in CLASSES.items() for number in operations}
OPERATIONS = {number: name for operations in CLASSES.values() for number, name in operations.items()}
INSTRUCTION = 16  # bytes

_REGISTERS, _FRAME = 0x2F, 0x11  # entries of .nv.info: registers a thread, bytes of stack


@dataclass(frozen=True)
class KernelCode:
    """name: the kernel's; code: its instructions; registers: a thread; stack: bytes a thread of local memory for arrays and
    spills; shared: bytes a block of the memory that its threads share."""

    name: str
    code: bytes
    registers: int
    stack: int
    shared: int = 0

    def opcodes(self) -> list[int]:
        """The operation of each instruction, without what stands behind the end: a branch to itself, and padding."""
        words = struct.unpack(f"<{len(self.code) // 8}Q", self.code)
        out = [word & 0x1FF for word in words[::2]]
        while out and OPERATIONS.get(out[-1]) in ("NOP", "BRA"):
            out.pop()
        return out

    def operations(self) -> Counter[str]:
        """How often each operation stands in the code, which is not how often it runs."""
        return Counter(OPERATIONS.get(each, f"0x{each:03x}") for each in self.opcodes())

    def classes(self) -> Counter[str]:
        """The same by class."""
        return Counter(CLASS_OF.get(each, "other") for each in self.opcodes())


def read_cubin(data: bytes) -> dict[str, KernelCode]:
    """Every kernel of a CUDA binary (an ELF file of 64 bits) by its name. Raises InputError where it is none."""
    try:
        return _read(data)
    except (struct.error, IndexError, ValueError) as error:
        raise InputError("is no CUDA binary that can be read") from error


def _read(data: bytes) -> dict[str, KernelCode]:
    if data[:5] != b"\x7fELF\x02":
        raise ValueError(data[:5])
    (offset,) = struct.unpack_from("<Q", data, 40)
    size, count, names = struct.unpack_from("<HHH", data, 58)
    sections = [struct.unpack_from("<IIQQQQIIQQ", data, offset + i * size) for i in range(count)]

    def content(section: tuple[int, ...]) -> bytes:
        return data[section[4]:section[4] + section[5]]

    def text(table: bytes, at: int) -> str:
        return table[at:table.index(b"\0", at)].decode()

    by_name = {text(content(sections[names]), section[0]): section for section in sections}
    symbols, strings = content(by_name[".symtab"]), content(by_name[".strtab"])
    labels = [text(strings, struct.unpack_from("<I", symbols, at)[0]) for at in range(0, len(symbols), 24)]
    facts = _facts(content(by_name[".nv.info"]))
    out = {}
    for name, section in by_name.items():
        if name.startswith(".text."):
            kernel = name.removeprefix(".text.")
            number = labels.index(kernel)
            shared = by_name.get(f".nv.shared.{kernel}")
            out[kernel] = KernelCode(kernel, content(section), facts.get((_REGISTERS, number), 0), facts.get((_FRAME, number), 0),
                                     shared[5] if shared else 0)
    return out


def _facts(info: bytes) -> dict[tuple[int, int], int]:
    """(entry, symbol) -> value, of the section that tells of all kernels."""
    out, at = {}, 0
    while at + 4 <= len(info):
        form, entry, size = struct.unpack_from("<BBH", info, at)
        at += 4
        if form == 4:  # `size` bytes follow
            if size == 8:
                symbol, value = struct.unpack_from("<II", info, at)
                out[entry, symbol] = value
            at += size
    return out
