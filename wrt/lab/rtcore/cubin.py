"""Read code, registers, stack and instructions of the kernels in a CUDA binary, without NVIDIA's tools.

Since Volta an instruction has 16 bytes, and its lowest 9 bits number the operation. NVIDIA has not published the numbers. OPERATIONS comes
from binaries of known source, a method of Jia et al. (2019, "Dissecting the NVIDIA Turing T4 GPU via Microbenchmarking"). A test compiles
some operations and checks their numbers. Unknown operations count as "other"."""

import struct
from collections import Counter
from dataclasses import dataclass
from io import BytesIO
from typing import Any

from wrt.core.errors import InputError
from wrt.core.packages import needed_by

# Class of instructions -> number -> name of Turing's operations.
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

_REGISTERS, _FRAME = 0x2F, 0x11  # entries of .nv.info: registers of a thread, bytes of a thread's stack


@dataclass(frozen=True)
class KernelCode:
    """Machine code of a kernel. registers: number for a thread; stack: bytes of a thread; shared: bytes of a block's shared memory."""

    name: str
    code: bytes
    registers: int
    stack: int
    shared: int = 0

    def opcodes(self) -> list[int]:
        """Return the operation number of each instruction, without the padding at the end (NOPs and a branch to itself)."""
        words = struct.unpack(f"<{len(self.code) // 8}Q", self.code)
        out = [word & 0x1FF for word in words[::2]]
        while out and OPERATIONS.get(out[-1]) in ("NOP", "BRA"):
            out.pop()
        return out

    def operations(self) -> Counter[str]:
        """Count how often each operation stands in the code (not how often it runs)."""
        return Counter(OPERATIONS.get(each, f"0x{each:03x}") for each in self.opcodes())

    def classes(self) -> Counter[str]:
        """Count the instructions of each class."""
        return Counter(CLASS_OF.get(each, "other") for each in self.opcodes())


def read_cubin(data: bytes) -> dict[str, KernelCode]:
    """Return every kernel of a CUDA binary (a 64-bit ELF file) by name. Raise InputError for anything else."""
    with needed_by("reading CUDA binaries"):
        from elftools.common.exceptions import ELFError
        from elftools.elf.elffile import ELFFile
    out = {}
    try:
        sections: dict[str, Any] = {section.name: section for section in ELFFile(BytesIO(data)).iter_sections()}
        numbers = {symbol.name: i for i, symbol in enumerate(sections[".symtab"].iter_symbols())}
        facts = _facts(sections[".nv.info"].data())
        for name in (name.removeprefix(".text.") for name in sections if name.startswith(".text.")):
            number, shared = numbers[name], sections.get(f".nv.shared.{name}")
            out[name] = KernelCode(name, sections[f".text.{name}"].data(), facts.get((_REGISTERS, number), 0),
                                   facts.get((_FRAME, number), 0), shared.data_size if shared else 0)
    except (ELFError, KeyError, struct.error) as error:
        raise InputError("this is no readable CUDA binary (a 64-bit ELF file with kernels)") from error
    return out


def _facts(info: bytes) -> dict[tuple[int, int], int]:
    """Return (kind of entry, index of a kernel's symbol) -> value, from the section .nv.info."""
    out, at = {}, 0
    while at < len(info):
        form, entry, size = struct.unpack_from("<BBH", info, at)
        at += 4 + (size if form == 4 else 0)  # form 4 has `size` more bytes
        if form == 4 and size == 8:
            symbol, value = struct.unpack_from("<II", info, at - 8)
            out[entry, symbol] = value
    return out
