/* Lets User Mode Linux run on processors whose XSAVE area is larger than it expects.
 *
 * UML up to 6.12 keeps a guest's vector registers in 2696 bytes, which ends with AVX-512 and PKRU.
 * PTRACE_SETREGSET(NT_X86_XSTATE) accepts only the host's whole area, which with AMX has 11008
 * bytes: the guest panics with "ptrace set fp regs failed, errno = 14". Preloaded into linux.uml,
 * this `ptrace` completes such a short area. The parts that the guest cannot hold are marked as
 * being in their initial state; no guest can use them, since they need a permission (arch_prctl)
 * that UML does not pass on. Everything up to AVX-512 is kept in full.
 *
 * Layout: Intel SDM volume 1, section 13.4 (XSAVE area) and CPUID leaf 0DH.
 */
#include <cpuid.h>
#include <errno.h>
#include <stdarg.h>
#include <stdint.h>
#include <string.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

enum { PEEKTEXT = 1, PEEKUSER = 3, GETREGSET = 0x4204, SETREGSET = 0x4205 }; /* linux/ptrace.h */
enum { NT_X86_XSTATE = 0x202 };                                              /* linux/elf.h */
enum { XSTATE_BV = 512, FIRST_EXTENDED = 2, COMPONENTS = 63 };
enum { LARGEST = 64 * 1024 };

static _Alignas(64) unsigned char area[LARGEST]; /* UML's kernel is one thread */
static size_t whole_size;
static uint64_t held;

/* Size of the host's area, and the components that lie wholly within `size` bytes of it. */
static long measure(long pid, size_t size)
{
    struct iovec whole = { area, LARGEST };
    if (syscall(SYS_ptrace, (long)GETREGSET, pid, (long)NT_X86_XSTATE, &whole) < 0)
        return -1;
    held = (1u << FIRST_EXTENDED) - 1; /* x87 and SSE: the legacy area */
    for (unsigned i = FIRST_EXTENDED; i < COMPONENTS; i++) {
        unsigned bytes, offset, flags, reserved;
        __cpuid_count(0x0d, i, bytes, offset, flags, reserved);
        if (bytes != 0 && offset + (size_t)bytes <= size)
            held |= 1ull << i;
    }
    whole_size = whole.iov_len;
    return 0;
}

static long set_xstate(long pid, struct iovec *given)
{
    if (whole_size == 0 && measure(pid, given->iov_len) < 0)
        return -1;
    if (given->iov_len >= whole_size)
        return syscall(SYS_ptrace, (long)SETREGSET, pid, (long)NT_X86_XSTATE, given);
    uint64_t present;
    memset(area, 0, whole_size);
    memcpy(area, given->iov_base, given->iov_len);
    memcpy(&present, area + XSTATE_BV, sizeof present);
    present &= held;
    memcpy(area + XSTATE_BV, &present, sizeof present);
    struct iovec whole = { area, whole_size };
    return syscall(SYS_ptrace, (long)SETREGSET, pid, (long)NT_X86_XSTATE, &whole);
}

long ptrace(int request, ...)
{
    va_list args;
    va_start(args, request);
    long pid = va_arg(args, int);
    long addr = va_arg(args, long);
    void *data = va_arg(args, void *);
    va_end(args);

    if (request == SETREGSET && addr == NT_X86_XSTATE)
        return set_xstate(pid, data);
    if (request < PEEKTEXT || request > PEEKUSER)
        return syscall(SYS_ptrace, (long)request, pid, addr, data);
    long word; /* the system call stores what the C library's function returns */
    if (syscall(SYS_ptrace, (long)request, pid, addr, &word) < 0)
        return -1;
    errno = 0;
    return word;
}
