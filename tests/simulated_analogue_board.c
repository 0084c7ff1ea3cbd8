/* A board that is not here: an ATmega328P in simavr, an AD5754R on its SPI and a serial port.
 *
 * The microcontroller runs the very firmware that a real one would. The DAC is a model written from
 * its data sheet: 24-bit frames, input and output registers, LDAC, read-back. The serial port is a
 * pseudo-terminal on which bytes take about as long as at the given baud rate. Prints the port, then a line
 * for every change of a voltage: cycles, source, three volts.
 *
 * usage: simulated_analogue_board FIRMWARE.elf BAUD EEPROM_FILE [STUCK_BITS]
 *   STUCK_BITS: bits of channel 0 that never become one, a fault for tests.
 */
#define _GNU_SOURCE
#include <avr_eeprom.h>
#include <avr_ioport.h>
#include <avr_spi.h>
#include <avr_timer.h>
#include <avr_uart.h>
#include <fcntl.h>
#include <signal.h>
#include <sim_avr.h>
#include <sim_elf.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#define HZ 16000000ULL
#define PACE_CYCLES (HZ / 5000)
#define CHANNELS 4
#define FULL_SCALE_V 10.0

static avr_t *avr;
static int port = -1, room;
static avr_irq_t *uart_in, *spi_in;
static avr_cycle_count_t bit_cycles;
static volatile sig_atomic_t ended;

static struct {
    uint16_t input[CHANNELS], output[CHANNELS], range, power, stuck;
    uint32_t shift, answer;
    int bytes, selected, volts_known;
} dac = {.bytes = 0};
static uint8_t width[3];

static void end(int number) {
    (void)number;
    ended = 1;
}

static void tell(const char *source, double a, double b, double c) {
    printf("%llu %s %.6f %.6f %.6f\n", (unsigned long long)avr->cycle, source, a, b, c);
    fflush(stdout);
}

static double dac_volts(int channel) {
    if (dac.range != 1 || !(dac.power & (1 << channel))) {
        return 0.0; /* powered down or in a range that the firmware does not use */
    }
    return FULL_SCALE_V * dac.output[channel] / 65536.0;
}

static uint16_t dac_register(int what, int address) {
    switch (what) {
    case 0:
        return address < CHANNELS ? dac.output[address] : 0;
    case 1:
        return dac.range;
    case 2:
        return dac.power;
    }
    return 0;
}

static void dac_execute(void) {
    int head = dac.shift >> 16 & 0xFF, what = head >> 3 & 7, address = head & 7;
    uint16_t value = dac.shift & 0xFFFF;
    if (head & 0x80) {
        dac.answer = dac_register(what, address);
        return;
    }
    if (what == 0 && address < CHANNELS) {
        dac.input[address] = address == 0 ? value & ~dac.stuck : value;
    } else if (what == 1) {
        dac.range = value & 7;
    } else if (what == 2) {
        dac.power = value & 0x1F;
    }
}

static void on_spi(avr_irq_t *irq, uint32_t value, void *unused) {
    (void)irq, (void)unused;
    if (!dac.selected) {
        return;
    }
    avr_raise_irq(spi_in, dac.bytes == 0 ? 0 : dac.answer >> (8 * (2 - dac.bytes)) & 0xFF);
    dac.shift = (dac.shift << 8 | (value & 0xFF)) & 0xFFFFFF;
    dac.bytes++;
}

static void on_sync(avr_irq_t *irq, uint32_t high, void *unused) {
    (void)irq, (void)unused;
    if (high && dac.selected && dac.bytes == 3) {
        dac_execute();
    }
    dac.selected = !high;
    dac.bytes = 0;
}

static void on_ldac(avr_irq_t *irq, uint32_t high, void *unused) {
    (void)irq, (void)unused;
    if (!high) {
        if (!dac.volts_known || memcmp(dac.output, dac.input, sizeof dac.output)) {
            memcpy(dac.output, dac.input, sizeof dac.output);
            dac.volts_known = 1;
            tell("dac", dac_volts(0), dac_volts(1), dac_volts(2));
        }
    }
}

static void on_pwm(avr_irq_t *irq, uint32_t value, void *place) {
    (void)irq;
    uint8_t *kept = &width[(size_t)place];
    if (*kept != (value & 0xFF)) {
        *kept = value & 0xFF;
        tell("pwm", FULL_SCALE_V * width[0] / 255, FULL_SCALE_V * width[1] / 255,
             FULL_SCALE_V * width[2] / 255);
    }
}

static void on_sent(avr_irq_t *irq, uint32_t value, void *unused) {
    (void)irq, (void)unused;
    uint8_t byte = value;
    while (write(port, &byte, 1) < 0 && !ended) {
    }
}

/* simavr tells whenever the firmware polls an empty port. Its queue, once full, never recovers: one
 * byte at a time, which takes 11 bits and the time until the firmware takes it. */
static void on_room(avr_irq_t *irq, uint32_t value, void *unused) {
    (void)irq, (void)unused;
    room = value != 0;
}

static avr_cycle_count_t feed(avr_t *unused, avr_cycle_count_t when, void *nothing) {
    (void)unused, (void)nothing;
    uint8_t byte;
    if (room && read(port, &byte, 1) == 1) {
        room = 0;
        avr_raise_irq(uart_in, byte);
    }
    return when + bit_cycles;
}

static void at_once(avr_t *unused, avr_cycle_count_t cycles) { (void)unused, (void)cycles; }

static void open_port(void) {
    struct termios raw;
    port = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK);
    if (port < 0 || grantpt(port) || unlockpt(port)) {
        perror("pseudo-terminal");
        exit(1);
    }
    /* Kept open, so that a host may come and go. */
    int other = open(ptsname(port), O_RDWR | O_NOCTTY);
    tcgetattr(other, &raw);
    cfmakeraw(&raw);
    tcsetattr(other, TCSANOW, &raw);
}

static void eeprom(const char *path, int save) {
    uint8_t kept[1024];
    avr_eeprom_desc_t all = {.ee = save ? NULL : kept, .offset = 0, .size = sizeof kept};
    FILE *file = fopen(path, save ? "wb" : "rb");
    if (!file) {
        return;
    }
    if (save) {
        avr_ioctl(avr, AVR_IOCTL_EEPROM_GET, &all);
        fwrite(all.ee, 1, sizeof kept, file);
    } else if (fread(kept, 1, sizeof kept, file) == sizeof kept) {
        avr_ioctl(avr, AVR_IOCTL_EEPROM_SET, &all);
    }
    fclose(file);
}

static void keep_pace(const struct timespec *begun) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    long long passed = (now.tv_sec - begun->tv_sec) * 1000000000LL + now.tv_nsec - begun->tv_nsec;
    long long simulated = avr->cycle * 1000LL / (HZ / 1000000ULL);
    if (simulated > passed) {
        struct timespec rest = {.tv_sec = 0, .tv_nsec = simulated - passed};
        nanosleep(&rest, NULL);
    }
}

int main(int argc, char **argv) {
    elf_firmware_t firmware;
    struct timespec begun;
    avr_cycle_count_t next = 0;
    if (argc < 4) {
        fprintf(stderr, "usage: %s FIRMWARE.elf BAUD EEPROM_FILE [STUCK_BITS]\n", argv[0]);
        return 2;
    }
    memset(&firmware, 0, sizeof firmware);
    if (elf_read_firmware(argv[1], &firmware)) {
        return 1;
    }
    dac.stuck = argc > 4 ? strtoul(argv[4], NULL, 0) : 0;
    avr = avr_make_mcu_by_name("atmega328p");
    avr_init(avr);
    avr->frequency = HZ;
    avr->sleep = at_once;
    avr->log = LOG_ERROR;
    avr_load_firmware(avr, &firmware);
    eeprom(argv[3], 0);
    open_port();
    bit_cycles = HZ / strtoull(argv[2], NULL, 10);

    uint32_t flags = 0;
    avr_ioctl(avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
    flags &= ~(AVR_UART_FLAG_STDIO | AVR_UART_FLAG_POLL_SLEEP);
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    uart_in = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    spi_in = avr_io_getirq(avr, AVR_IOCTL_SPI_GETIRQ(0), SPI_IRQ_INPUT);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_sent, NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_SPI_GETIRQ(0), SPI_IRQ_OUTPUT), on_spi, NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), 2), on_sync, NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), 1), on_ldac, NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_TIMER_GETIRQ('0'), TIMER_IRQ_OUT_PWM0), on_pwm, (void *)0);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_TIMER_GETIRQ('0'), TIMER_IRQ_OUT_PWM1), on_pwm, (void *)1);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_TIMER_GETIRQ('2'), TIMER_IRQ_OUT_PWM1), on_pwm, (void *)2);
    avr_irq_t *xon = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XON);
    xon->flags &= ~IRQ_FLAG_FILTERED;
    avr_irq_register_notify(xon, on_room, NULL);
    avr_cycle_timer_register(avr, bit_cycles, feed, NULL);

    signal(SIGTERM, end);
    signal(SIGINT, end);
    printf("port %s\n", ptsname(port));
    fflush(stdout);
    clock_gettime(CLOCK_MONOTONIC, &begun);
    while (!ended) {
        int state = avr_run(avr);
        if (state == cpu_Done || state == cpu_Crashed) {
            fprintf(stderr, "the microcontroller stopped in state %d\n", state);
            return 1;
        }
        if (avr->cycle >= next) {
            next = avr->cycle + PACE_CYCLES;
            keep_pace(&begun);
        }
    }
    eeprom(argv[3], 1);
    return 0;
}
