"""What a CUDA binary tells without any of NVIDIA's tools: the code, registers and stack of a kernel."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from wrt.errors import InputError

_REGISTERS, _FRAME = 0x2F, 0x11  # entries of .nv.info: registers a thread, bytes of stack


@dataclass(frozen=True)
class KernelCode:
    """name: the kernel's; code: its instructions; registers: a thread; stack: bytes a thread of local memory for arrays and
    spills."""

    name: str
    code: bytes
    registers: int
    stack: int


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
            out[kernel] = KernelCode(kernel, content(section), facts.get((_REGISTERS, number), 0), facts.get((_FRAME, number), 0))
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
