/* Counts the frames of `udccal run --sink shm:NAME`; docs/live.md has the layout. cc -O2 -o read_live read_live.c */
#include <fcntl.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

struct header { /* constant but for the last two */
    char magic[8];
    uint32_t version, header_bytes, width, height, stride, format, slots, edge_bytes;
    uint64_t slot_bytes, first_slot, newest, closed;
};

static uint64_t word(const void *place) { return __atomic_load_n((const uint64_t *)place, __ATOMIC_ACQUIRE); }

static int failed(const char *why) { return fprintf(stderr, "%s\n", why), 1; }

int main(int count, char **words) {
    char path[128];
    struct stat size;
    snprintf(path, sizeof path, "/%s", count > 1 ? words[1] : "");
    int file = shm_open(path, O_RDONLY, 0);
    if (file < 0 || fstat(file, &size) != 0) return perror("shm_open"), 1;
    const char *memory = mmap(NULL, size.st_size, PROT_READ, MAP_SHARED, file, 0);
    const struct header *header = (const struct header *)memory;
    if (memory == MAP_FAILED || memcmp(header->magic, "UDCCALFR", 8) != 0 || header->version != 1)
        return failed("expected frames of udccal, version 1, found something else");
    size_t bytes = (size_t)header->stride * header->height;
    unsigned char *picture = malloc(bytes);
    for (uint64_t seen = 0, newest; !word(&header->closed); seen = newest) {
        if ((newest = word(&header->newest)) == seen) { /* the writer locks the memory for as long as it lives */
            if (flock(file, LOCK_SH | LOCK_NB) == 0 && !word(&header->closed))
                return failed("expected the writer to live, found that it was killed; start it again");
            usleep(1000);
            continue;
        }
        const char *slot = memory + header->first_slot + (newest - 1) % header->slots * header->slot_bytes;
        uint64_t last = word(slot + header->slot_bytes - header->edge_bytes); /* first of all */
        memcpy(picture, slot + header->edge_bytes, bytes);
        uint64_t sum = 0, frame_id = word(slot + 8);
        __atomic_thread_fence(__ATOMIC_ACQUIRE);
        int whole = last == newest && word(slot) == newest; /* last of all */
        for (size_t i = 0; i < bytes; i++) sum += picture[i];
        printf("frame %llu: ", (unsigned long long)frame_id);
        if (whole) printf("mean %.2f\n", (double)sum / bytes);
        else printf("torn\n");
        fflush(stdout);
    }
    return 0;
}
